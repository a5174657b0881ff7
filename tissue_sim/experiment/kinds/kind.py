"""Kinds of test: definition, and registry by name. A kind names the deformation; a protocol controls the test.

A new kind is a `TestKind` in a file of this folder and a line in `KINDS`, or an entry point of the group
``tissue_sim.kinds`` in another package. Campaigns, recordings, calibration, command line and viewer read the attributes
of a kind and depend on no name. The module does not import numpy, so that ``--help`` stays fast.
"""

from __future__ import annotations

import warnings
from dataclasses import InitVar, dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.errors import InputError
from tissue_sim.experiment.grip import GripMotion
from tissue_sim.experiment.tools.shapes import Plate
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.public_names import OldName, with_old_names
from tissue_sim.registry import Registry

if TYPE_CHECKING:
    from tissue_sim.experiment.experiment import Experiment
    from tissue_sim.experiment.protocol import Protocol
    from tissue_sim.specimen import Specimen

#: Channels (motion, load) of a recording from a load frame.
DISPLACEMENT_FORCE = ("displacement", "force")
#: Channels of a torsion test.
ANGLE_TORQUE = ("angle", "torque")
#: Channels of a stress-stretch curve.
STRETCH_STRESS = ("stretch", "nominal stress")
#: Moduli of small oscillations that a model predicts.
MODULI = ("storage modulus", "loss modulus")
#: Pairs of channels of a table of moduli; one of them and the frequency determine both moduli.
MODULUS_PAIRS = (MODULI, ("storage modulus", "loss factor"), ("complex modulus", "loss factor"),
                 ("loss modulus", "loss factor"))
#: Channels of a shear curve.
SHEAR_STRESS = ("shear strain", "nominal stress")


def has_modulus_channels(present: Any) -> bool:
    """Return whether channels are those of a table of moduli: a frequency and two moduli, or one and the loss factor.

    Args:
        present: names of the channels.
    """
    return any({"frequency", *pair} <= set(present) for pair in MODULUS_PAIRS)


@dataclass(frozen=True)
class FaceInterface:
    """Default interface of one face in a kind of test, and who may change it; see `tissue_sim.experiment.contact_law`.

    Attributes:
        usual: default interface.
        fixed: whether the kind determines the interface, so that a campaign cannot change it.
        stated: whether a campaign must state the interface.
    """

    usual: str | float
    fixed: bool = False
    stated: bool = False


@dataclass(frozen=True)
class SizeNames:
    """Names by which files and messages state the sizes of a specimen in a kind of test.

    Attributes:
        height: names of the size along the load, the first in messages; a file that states several is read in this
            order.
        second: names of the second side of a rectangular cross-section; the first side is the width.
        is_round: whether the cross-section must be a circle although the specimen is gripped.
    """

    height: tuple[str, ...] = ("height", "thickness", "length", "gauge length", "gap")
    second: tuple[str, ...] = ("length", "depth", "thickness")
    is_round: bool = False


@with_old_names(can_pull="allows_reversed_load")
@dataclass(frozen=True, kw_only=True)
class TestKind:
    """Kind of test: default tool, interfaces, channels, sign of the load, and closed form if one exists.

    Attributes:
        name: name in files and on the command line.
        title: name in reports.
        tool: default tool; a plate admits plates only, a needle all tools but plates. None: the specimen is gripped at
            both ends.
        grip: motion of the upper grip in the finite elements, which bond the ends of the specimen to rigid grips. None
            without a tool: the test is not simulated.
        specimen_shapes: shapes of the specimen that the finite elements accept; empty: all.
        tool_stated: whether a campaign must state the shape of the tool.
        has_lateral_wall: whether rigid walls without friction hold the side of the specimen.
        face, base, shaft: interfaces of the tool's face, of the base and of a needle's shaft.
        sign: sign of strain and nominal stress for positive displacement and force: -1 in compression, 1 in tension.
        channels: alternatives, each a motion and its load; a recording needs one of them. The first is that of the
            machine. A kind with several loads lists a motion and a load for each of them, such as (displacement, force,
            displacement 2, force 2); see `select_load`.
        load_names: names of the loads, which a campaign appends to the name of the test; empty for one load.
        closed_form: nominal stress of the homogeneous deformation; None if only finite elements give the force.
        size_names: names of the sizes of the specimen.
        title_words: regular expressions of words by which titles and headers of files name the test, in addition to
            `name` and `title`: lower case, without accents, words separated by one blank. Of overlapping words the
            longest counts; see `tissue_sim.recording.formats.kind_words`.
        is_default_of_direction: whether one word for the direction of loading, such as compression, names the kind
            unless the same text names another kind.
        file_words: abbreviations that are recognised only in the name of a file.
        sole_words: words that are recognised only if they are the complete text (a number may follow), such as the name
            of a sheet, or if an entry for the test method contains no other test word.

    Raises:
        InputError: neither a tool nor a closed form, or a control other than the old value ``"displacement"``.
    """

    __test__: ClassVar[bool] = False  # for pytest

    name: str
    title: str
    tool: Tool | None
    grip: GripMotion | None = None
    specimen_shapes: tuple[str, ...] = ()
    tool_stated: bool = False
    has_lateral_wall: bool = False
    face: FaceInterface = FaceInterface("bonded", fixed=True)
    base: FaceInterface = FaceInterface("bonded", fixed=True)
    shaft: FaceInterface = FaceInterface("frictionless")
    sign: float
    channels: tuple[tuple[str, ...], ...] = (DISPLACEMENT_FORCE,)
    load_names: tuple[str, ...] = ()
    closed_form: ClosedForm | None = None
    size_names: SizeNames = SizeNames()
    title_words: tuple[str, ...] = ()
    is_default_of_direction: bool = False
    file_words: tuple[str, ...] = ()
    sole_words: tuple[str, ...] = ()
    control: InitVar[str | None] = None

    def __post_init__(self, control: str | None):
        if control not in (None, "displacement"):
            raise InputError(f"control must be left out; got {control!r}. The protocol prescribes displacement or "
                             "force", field="tissue_sim.kinds")
        if control is not None:
            warnings.warn("TestKind has no control; the protocol prescribes displacement or force. Leave control out",
                          DeprecationWarning, stacklevel=3)
        if self.tool is None and self.closed_form is None:
            raise InputError(f"{self.name!r} has neither a tool nor a closed form, so that no model computes its "
                             "force; give one of them", field="tissue_sim.kinds")
        for names in self.channels:
            if len(names) != 2 * self.load_count:
                raise InputError(f"must list a motion and a load for each of {self.load_count} loads; got "
                                 f"{', '.join(names)}.", field="tissue_sim.kinds.channels")
        if self.tool is not None and self.grip is not None:
            raise InputError(f"{self.name!r} has a tool and a grip; give one of them", field="tissue_sim.kinds")

    #: Old names.
    gripped = OldName("has_gripped_ends")
    settles = OldName("has_closed_form_with_weight")
    motion = OldName("loading_type_name")
    both_ways = OldName("loads_in_both_directions")
    interfaces = OldName("make_default_interfaces_by_field")
    faces = OldName("face_interfaces_by_field")
    fits = OldName("allows_tool")
    strain = OldName("convert_abscissa_to_nominal_strain")
    abscissa = OldName("convert_nominal_strain_to_stretch_or_shear_strain")

    @property
    def has_gripped_ends(self) -> bool:
        """Whether grips hold the specimen at both ends, without a tool; self-weight is then not supported."""
        return self.tool is None

    @property
    def allows_reversed_load(self) -> bool:
        """Whether the specimen can be pulled against the direction of loading: it is gripped, or the tool is bonded."""
        return self.has_gripped_ends or self.face.usual == "bonded"

    @property
    def is_simulated(self) -> bool:
        """Whether finite elements of the test exist: it has a tool, or a grip whose motion is stated."""
        return self.tool is not None or self.grip is not None

    @property
    def has_closed_form_with_weight(self) -> bool:
        """Whether a closed form exists also under self-weight: that of `tissue_sim.closed_form.column`."""
        return self.closed_form is not None and self.closed_form.has_column and self.tool is not None

    @property
    def loading_type_name(self) -> str:
        """Last word of the kind's name, for messages, such as ``compression``."""
        return self.name.rpartition("_")[2]

    @property
    def strain_name(self) -> str:
        """Name of the result of `convert_abscissa_to_nominal_strain`, for labels of axes."""
        if self.has_several_motions:
            return "equivalent strain"
        return "shear strain" if self.loads_in_both_directions else "nominal strain"

    @property
    def load_count(self) -> int:
        """Number of loads of a recording that a model predicts."""
        return len(self.load_names) or 1

    @property
    def has_several_motions(self) -> bool:
        """Whether several motions determine each load, as in biaxial tension."""
        return len(set(self.channels[0][::2])) > 1

    def select_load(self, number: int) -> TestKind:
        """Return the kind with one of its loads as the first one; the other motions and loads follow in turn.

        A campaign treats each load of a recording as a separate test of this kind.

        Args:
            number: index of the load, from 0.
        """
        if self.load_count == 1:
            return self
        channels = tuple(names[2 * number:] + names[:2 * number] for names in self.channels)
        form = None if self.closed_form is None else self.closed_form.select_load(number)
        return replace(self, channels=channels, closed_form=form)

    @property
    def loads_in_both_directions(self) -> bool:
        """Whether the specimen may be loaded in both directions, as in shear."""
        return self.closed_form is not None and self.closed_form.rest == 0

    def make_default_interfaces_by_field(self, tool: Tool) -> dict[str, str | float]:
        """Return the default interfaces with a tool: field of `Experiment` -> interface.

        A tip without a flat face cannot be bonded to tissue that it meets during the test; it sticks instead.
        """
        usual = {field: face.usual for field, face in self.face_interfaces_by_field.items()}
        return usual | {"friction": "stick"} if usual["friction"] == "bonded" and tool.face_radius == 0 else usual

    @property
    def face_interfaces_by_field(self) -> dict[str, FaceInterface]:
        """Field of `Experiment`, such as ``friction_base`` -> interface of that face in this kind of test."""
        return {"friction": self.face, "friction_base": self.base, "friction_wall": self.shaft}

    def allows_tool(self, tool: type[Tool] | Tool) -> bool:
        """Return whether this kind of test can be done with a tool or a class of tools."""
        return self.tool is not None and tool.is_plate == self.tool.is_plate

    def convert_abscissa_to_nominal_strain(self, abscissa: Any) -> Any:
        """Return the nominal strain (in shear the shear strain), positive under load, of a stretch or shear strain.

        Raises:
            InputError: the kind has no closed form.

        Examples:
            >>> round(KINDS["lubricated_compression"].convert_abscissa_to_nominal_strain(0.9), 3)
            0.1
        """
        return self.sign * (abscissa - self.require_closed_form().rest)

    def convert_nominal_strain_to_stretch_or_shear_strain(self, strain: Any) -> Any:
        """Return the stretch (in shear the shear strain) of a nominal strain.

        This is the inverse of `convert_abscissa_to_nominal_strain`.

        Raises:
            InputError: the kind has no closed form.

        Examples:
            >>> KINDS["lubricated_compression"].convert_nominal_strain_to_stretch_or_shear_strain(0.1)
            0.9
        """
        return self.require_closed_form().rest + self.sign * strain

    def require_closed_form(self) -> ClosedForm:
        """Return the closed form of the stress of this kind of test.

        Raises:
            InputError: the kind has no closed form.
        """
        if self.closed_form is None:
            raise InputError(f"{self.name} has no closed form; use the finite elements", field="kind")
        return self.closed_form

    def require_tool(self) -> Tool:
        """Return the default tool of this kind of test.

        Raises:
            InputError: the specimen is gripped.
        """
        if self.tool is None:
            raise InputError(f"{self.name} has no tool and is not simulated; use its closed form", field="kind")
        return self.tool

    def require_channels(self, present: Any, has: str, **place: Any) -> None:
        """Require one of the alternatives of channels, or the channels of a table of moduli.

        Args:
            present: names of the channels of a recording.
            has: description of the channels, for the message.
            place: arguments of `InputError`, such as file and line.

        Raises:
            InputError: the recording has none of the alternatives.
        """
        if self.closed_form is not None and has_modulus_channels(present):
            return
        if not any(set(names) <= set(present) for names in self.channels):
            needs = " or ".join(" and ".join(map(repr, dict.fromkeys(names))) for names in self.channels)
            raise InputError(f"{self.name} needs columns {needs}; {has}", **place)

    def experiment(self, *, specimen: Specimen, protocol: Protocol, **overrides: Any) -> Experiment:
        """Make the experiment of this kind on a specimen.

        Args:
            specimen: geometry, density and gravity.
            protocol: motion of the tool or of the upper grip.
            overrides: other fields of `Experiment`; `tool`, `friction`, `friction_base` and `friction_wall` replace the
                defaults of the kind.

        Raises:
            InputError: see `Experiment`; or a kind without tool and grip, or a specimen whose shape does not fit.

        Examples:
            >>> from tissue_sim import Protocol, Specimen, Tool
            >>> needle = KINDS["needle_indentation"].experiment(
            ...     specimen=Specimen(0.040, 0.070), protocol=Protocol.ramp(0.002), tool=Tool("flat", radius=0.008))
            >>> needle.friction
            'bonded'
        """
        from tissue_sim.experiment.experiment import Experiment

        if self.grip is not None:
            if self.specimen_shapes and specimen.shape not in self.specimen_shapes:
                raise InputError(f"must be a {' or a '.join(self.specimen_shapes)} in {self.title.lower()}; got "
                                 f"{specimen.in_words}. Choose another shape", field="specimen")
            # A rigid grip is a bonded plate.
            overrides = {"tool": Plate(), "grip": self.grip} | overrides
        tool = overrides.get("tool") or self.require_tool()
        stated: dict[str, Any] = {"tool": tool, "has_lateral_wall": self.has_lateral_wall,
                                  **self.make_default_interfaces_by_field(tool)} | overrides
        return Experiment(specimen, protocol, **stated)


#: Name -> kind of test.
KINDS: Registry[TestKind] = Registry("kind of test", "tissue_sim.kinds", {
    "lubricated_compression": "tissue_sim.experiment.kinds.standard_tests:LUBRICATED",
    "bonded_compression": "tissue_sim.experiment.kinds.standard_tests:BONDED",
    "friction_compression": "tissue_sim.experiment.kinds.standard_tests:FRICTION",
    "confined_compression": "tissue_sim.experiment.kinds.confined_compression:CONFINED_COMPRESSION",
    "needle_indentation": "tissue_sim.experiment.kinds.standard_tests:NEEDLE",
    "uniaxial_tension": "tissue_sim.experiment.kinds.standard_tests:TENSION",
    "simple_shear": "tissue_sim.experiment.kinds.standard_tests:SHEAR",
    "torsion": "tissue_sim.experiment.kinds.torsion:TORSION_TEST",
    "torsion_axial_force": "tissue_sim.experiment.kinds.torsion:TORSION_AXIAL_FORCE",
    "planar_tension": "tissue_sim.experiment.kinds.sheet_tension:PLANAR_TENSION",
    "equibiaxial_tension": "tissue_sim.experiment.kinds.sheet_tension:EQUIBIAXIAL_TENSION",
    "biaxial_tension": "tissue_sim.experiment.kinds.biaxial_tension:BIAXIAL_TENSION",
}, accepts=lambda kind: isinstance(kind, TestKind), expected="a tissue_sim.TestKind")
