"""Forward model of tables of storage and loss modulus: the complex modulus of small oscillations about a pre-strain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.forward.contract import InfeasibleError, StretchRange
from calibration.forward.motion import DIFFERENCES
from calibration.forward.simulation_cache import SimulationCache
from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import TestKind
from tissue_sim.parameters import with_values
from tissue_sim.rig.modulus_readout import ModulusReadout

#: Strain amplitude with which the range of stretches of a table is computed; a table need not state its amplitude.
ASSUMED_AMPLITUDE = 0.01


@dataclass(frozen=True)
class ModulusParameters:
    """Parameter values for `ModulusTest.evaluate_force_and_derivatives`.

    Attributes:
        space: parameter space.
        values: name -> value of all parameters, SI.
    """

    space: ParameterSpace
    values: dict[str, float]


@dataclass(eq=False)
class ModulusTest:
    """Forward model of one modulus of a table, in the coordinates of a fit.

    The displacement of a curve is the frequency, Hz, and its force the logarithm of the modulus in Pa, whose noise is
    that of the modulus relative to its value.

    Attributes:
        name: name of the test.
        kind: kind of the test.
        modulus: ``"storage modulus"`` or ``"loss modulus"``.
        abscissa: stretch or shear strain about which the specimen oscillates.
        measured: tables of the test.
    """

    name: str
    kind: TestKind
    modulus: str
    abscissa: float
    measured: tuple[MeasuredCurve, ...]

    is_force_proportional_to_moduli: ClassVar[bool] = False
    is_homogeneous: ClassVar[bool] = True
    mesh_key: ClassVar[str] = ""
    has_reversals_or_holds: ClassVar[bool] = False
    area: ClassVar[None] = None
    specimen: ClassVar[None] = None

    @property
    def closed_form(self) -> ClosedForm:
        """Closed form of the kind of test."""
        return self.kind.require_closed_form()

    @property
    def largest_strain_or_none(self) -> float | None:
        """I1 - 3 of the pre-strain; see `ForwardTest.largest_strain_or_none`."""
        return float(self.closed_form.compute_first_invariant(np.array(self.abscissa))) - 3.0

    def solve(self, space: ParameterSpace, theta: np.ndarray, solves: SimulationCache) -> ModulusParameters:
        """Return the parameter values."""
        return ModulusParameters(space, space.get_values_by_name(theta))

    def evaluate_force_and_derivatives(self, answer: ModulusParameters, recording: int,
                                       offset: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the logarithm of the modulus and its derivatives, see `ForwardTest`; a contact offset has no effect.

        Raises:
            InfeasibleError: the material is invalid, or the modulus is not positive.
        """
        curve, space, values = self.measured[recording], answer.space, answer.values
        found = self._compute_log_modulus(space, values, curve)
        rates = np.empty((found.size, len(space.free)))
        sizes = space.compute_typical_parameter_sizes(values)
        for k, (name, size) in enumerate(zip(space.free, sizes, strict=True)):
            ends = []
            for step in (DIFFERENCES.relative * size, -DIFFERENCES.relative * size):
                try:
                    ends.append((self._compute_log_modulus(space, values | {name: values[name] + step}, curve), step))
                except InfeasibleError:
                    # The value is at a bound: the difference is one-sided.
                    ends.append((found, 0.0))
            (above, high), (below, low) = ends
            if high == low:
                raise InfeasibleError(f"{self.name}: {name} has no valid neighbouring value")
            rates[:, k] = (above - below) / (high - low)
        return found, rates, np.zeros(found.size)

    def _compute_log_modulus(self, space: ParameterSpace, values: dict[str, float], curve: MeasuredCurve) -> np.ndarray:
        """Return the logarithm of the modulus in Pa at the frequencies of a curve, shape (n,)."""
        try:
            material = space.build_material(values, test=self.name, recording=curve.name)
            readout = with_values(ModulusReadout(), space.select_values_under_prefix(values, "readout.", self.name,
                                                                                     curve.name))
            with np.errstate(all="ignore"):
                modulus = readout.compute_reading(
                    self.closed_form.complex_modulus(material, curve.displacement, self.abscissa), curve.displacement)
        except InputError as error:
            raise InfeasibleError(f"{self.name}: {error}") from None
        part = modulus.real if self.modulus == "storage modulus" else modulus.imag
        if not (np.isfinite(part).all() and (part > 0.0).all()):
            raise InfeasibleError(f"{self.name}: the {self.modulus} of the model is not positive")
        return np.log(part)

    def remove_memory(self, answer: ModulusParameters, recording: int, columns: np.ndarray) -> np.ndarray:
        """Return the columns unchanged: a modulus over frequency has no displacement; see `ForwardTest`."""
        return columns

    def list_finite_difference_parameters(self, answer: ModulusParameters) -> frozenset[str]:
        """Return the names of the free parameters, whose derivatives are finite differences."""
        return frozenset(answer.space.free)

    def update_mesh_force_difference_and_get_ratio(self, space: ParameterSpace, theta: np.ndarray,
                                                   solves: SimulationCache) -> float:
        """Return 0 and change nothing: a closed form has no mesh error."""
        return 0.0

    def discard_mesh_correction(self) -> None:
        """Do nothing: a closed form has no mesh correction."""

    def compute_stretch_range(self, space: ParameterSpace, theta: np.ndarray) -> StretchRange:
        """Return the range of stretches from rest to the pre-strain, with an amplitude, see `ASSUMED_AMPLITUDE`."""
        form = self.closed_form
        low = min(self.abscissa, form.rest) - ASSUMED_AMPLITUDE
        high = max(self.abscissa, form.rest) + ASSUMED_AMPLITUDE
        principal = form.find_extreme_stretches(low, high)
        return StretchRange(form.mode, *((low, high) if form.rest else principal), principal)
