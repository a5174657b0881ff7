"""Biaxial tension of a sheet: two stretches and two loads along perpendicular axes.

Source: Kawabata, Matsuda, Tei and Kawai, Macromolecules 14 (1981) 154.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import SizeNames, TestKind

if TYPE_CHECKING:
    import numpy as np

    from tissue_sim.laws import Law
    from tissue_sim.material.material import Material
    from tissue_sim.specimen import Specimen


@dataclass(frozen=True)
class BiaxialForm(ClosedForm):
    """Nominal stress along one axis; the abscissa has the shape (..., 2), the stretch of this axis first.

    Attributes:
        axis: index of the axis, 0 or 1. The stress of an isotropic material is the same function on both axes.
    """

    axis: int = 0

    is_first_load_of_mode: ClassVar[bool] = True

    def select_load(self, number: int) -> BiaxialForm:
        """Return the closed form of the axis that follows this one by `number`."""
        return replace(self, axis=(self.axis + number) % 2)

    def stress(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the nominal stress along the axis, Pa; see `ClosedForm.stress`."""
        return law.nominal_stress(abscissa, values, self.law_mode)[..., 0]

    def slope(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the derivative of `stress` with respect to the stretch of the axis, Pa."""
        return law.nominal_stress_slope(abscissa, values, self.law_mode)[..., 0, 0]

    def stress_parameter_derivatives(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the derivatives of `stress` with respect to m parameters, shape (..., m)."""
        return law.nominal_stress_parameter_derivatives(abscissa, values, self.law_mode)[..., 0, :]

    def stress_history(self, material: Material, time: np.ndarray, abscissa: np.ndarray,
                       contact_radius: float) -> np.ndarray:
        """Return the nominal stress along the axis with relaxation and softening, Pa, shape (n,)."""
        return super().stress_history(material, time, abscissa, contact_radius)[:, 0]

    def convert_motion_and_load(self, specimen: Specimen, motion: np.ndarray,
                                load: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return strain and stress, Pa, of a displacement, m, and a force, N, of the axis of a sheet.

        Raises:
            InputError: the specimen is not a block.
        """
        from tissue_sim.specimen.block import Block

        if not isinstance(specimen, Block):
            raise InputError("must be a block with height_mm along axis 1, length_mm along axis 2 and the thickness as "
                             f"width_mm; got {specimen.in_words}", field="specimen.shape")
        own, other = (specimen.height, specimen.length)[::1 - 2 * self.axis]
        return motion / own, load / (other * specimen.width)


#: A sheet with grips at its four edges: the cross-section of an axis is the length along the other one times thickness.
BIAXIAL_TENSION = TestKind(
    name="biaxial_tension", title="Biaxial tension", tool=None, sign=1.0, load_names=("axis 1", "axis 2"), channels=(
        ("displacement", "force", "displacement 2", "force 2"),
        ("stretch", "nominal stress", "stretch 2", "nominal stress 2")),
    closed_form=BiaxialForm("biaxial", "equibiaxial", label="equivalent strain [-]"),
    size_names=SizeNames(("gauge length", "height"), ("thickness",)), file_words=("bt",), title_words=(
        r"bi ?axial\w*( (tension|tensile|extension|test\w*))?", r"biax\w*", r"zweiachs\w*( zug\w*)?", r"biaxialzug\w*",
        r"cruciform"))
