"""What a kind of test is, and the kinds by name.

A new kind is a `TestKind` in a file beside this one and a line in `KINDS`, or that of a package, by an entry point of
the group. Campaigns, recordings, calibration, command line and viewer ask it and know no name of a kind. Nothing here
needs numpy, so that help answers at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.registry import Registry

if TYPE_CHECKING:
    from tissue_sim.experiment.experiment import Experiment
    from tissue_sim.experiment.protocol import Protocol
    from tissue_sim.specimen import Specimen

#: Pairs of channels of a recording, motion and load.
DISPLACEMENT_FORCE, STRETCH_STRESS = ("displacement", "force"), ("stretch", "nominal stress")
SHEAR_STRESS = ("shear strain", "nominal stress")


@dataclass(frozen=True)
class Face:
    """How a face holds the tissue in a kind of test; see `tissue_sim.experiment.interfaces`.

    Attributes:
        usual: interface, where nothing is said.
        fixed: whether the name of the kind says it, so that a campaign cannot say anything else.
        stated: whether a campaign has to say it.
    """

    usual: str | float
    fixed: bool = False
    stated: bool = False


@dataclass(frozen=True, kw_only=True)
class TestKind:
    """A kind of test.

    Attributes:
        name: in files and on the command line.
        title: for people.
        tool: where nothing is said; a plate stands for plates only, a needle for all tools but plates. None: the
            specimen is gripped at both ends and is not simulated.
        tool_stated: whether a campaign has to say the shape of the tool.
        face, base, shaft: interfaces of the tool's face, of the base and of a needle's shaft.
        control: ``"displacement"``.
        sign: of strain and nominal stress under a positive displacement and force: -1 in compression, 1 in tension.
        channels: pairs (motion, load), one of which its recordings must have; the first is that of a load frame.
        closed_form: nominal stress of the homogeneous deformation; None where only the finite elements answer.
        title_words: regular expressions of words by which titles and headers of files name the test, besides `name`
            and `title`: lower case, without accents, words separated by one blank. Of words that overlap, the longest
            counts; see `tissue_sim.recording.formats.kind_words`.

    Raises:
        InputError: another control, or neither a tool nor a closed form.
    """

    __test__: ClassVar[bool] = False  # for pytest

    name: str
    title: str
    tool: Tool | None
    tool_stated: bool = False
    face: Face = Face("bonded", fixed=True)
    base: Face = Face("bonded", fixed=True)
    shaft: Face = Face("frictionless")
    control: str = "displacement"
    sign: float
    channels: tuple[tuple[str, str], ...] = (DISPLACEMENT_FORCE,)
    closed_form: ClosedForm | None = None
    title_words: tuple[str, ...] = ()

    def __post_init__(self):
        if self.control != "displacement":
            raise InputError(f"{self.name!r} is controlled by its {self.control}; the motion of a test is prescribed "
                             "here, so give control='displacement'", field="tissue_sim.kinds")
        if self.tool is None and self.closed_form is None:
            raise InputError(f"{self.name!r} has neither a tool nor a closed form, so nothing can answer it; give one "
                             "of them", field="tissue_sim.kinds")

    @property
    def gripped(self) -> bool:
        """Whether the specimen is held at both ends, without a tool, and can be no specimen that weighs."""
        return self.tool is None

    @property
    def can_pull(self) -> bool:
        """Whether a force against the direction of loading reaches the specimen: it is gripped, or the tool adheres."""
        return self.gripped or self.face.usual == "bonded"

    @property
    def settles(self) -> bool:
        """Whether it has a closed form too where the specimen weighs: that of `tissue_sim.closed_form.column`."""
        return self.closed_form is not None and self.tool is not None

    @property
    def motion(self) -> str:
        """What its samples do, in messages: ``compression``."""
        return self.name.rpartition("_")[2]

    @property
    def strain_name(self) -> str:
        """What `strain` gives, for axes."""
        return "shear strain" if self.both_ways else "nominal strain"

    @property
    def both_ways(self) -> bool:
        """Whether the specimen may be loaded to either side, as in shear."""
        return self.closed_form is not None and self.closed_form.rest == 0

    def interfaces(self, tool: Tool) -> dict[str, str | float]:
        """Field of `Experiment` -> interface with this tool, where nothing is said: a tip without a flat face cannot be
        bonded to tissue that comes to lie on it, and holds it without slip instead."""
        usual = {field: face.usual for field, face in self.faces.items()}
        return usual | {"friction": "stick"} if usual["friction"] == "bonded" and tool.face_radius == 0 else usual

    @property
    def faces(self) -> dict[str, Face]:
        """Field of `Experiment` -> face."""
        return {"friction": self.face, "friction_base": self.base, "friction_wall": self.shaft}

    def fits(self, tool: type[Tool] | Tool) -> bool:
        """Whether it is done with such a tool."""
        return self.tool is not None and tool.is_plate == self.tool.is_plate

    def strain(self, abscissa: Any) -> Any:
        """Nominal strain (shear strain of shear), positive under load, of a stretch or shear strain; any shape.

        Raises:
            InputError: no closed form.
        """
        return self.sign * (abscissa - self.require_closed_form().rest)

    def abscissa(self, strain: Any) -> Any:
        """What `strain` takes; any shape.

        Raises:
            InputError: no closed form.
        """
        return self.require_closed_form().rest + self.sign * strain

    def require_closed_form(self) -> ClosedForm:
        """Its closed form.

        Raises:
            InputError: it has none.
        """
        if self.closed_form is None:
            raise InputError(f"{self.name} has no closed form; use the finite elements", field="kind")
        return self.closed_form

    def require_tool(self) -> Tool:
        """The tool where nothing is said.

        Raises:
            InputError: the specimen is gripped.
        """
        if self.tool is None:
            raise InputError(f"{self.name} has no tool and is not simulated; its closed form answers", field="kind")
        return self.tool

    def require_channels(self, present: Any, has: str, **place: Any) -> None:
        """Refuse a recording without any of the pairs.

        Args:
            present: names of its channels. has: what it has, for the message. place: for `InputError`.
        """
        if not any(set(pair) <= set(present) for pair in self.channels):
            needs = " or ".join(f"{motion!r} and {load!r}" for motion, load in self.channels)
            raise InputError(f"{self.name} needs columns {needs}; {has}", **place)

    def experiment(self, *, specimen: Specimen, protocol: Protocol, **overrides: Any) -> Experiment:
        """The experiment on this specimen.

        Args:
            specimen: geometry, and whether it weighs.
            protocol: motion of the tool.
            overrides: other fields of `Experiment`; `tool`, `friction`, `friction_base` and `friction_wall` in place
                of the kind's own.

        Raises:
            InputError: what `Experiment` refuses, or a kind without a tool.
        """
        from tissue_sim.experiment.experiment import Experiment

        tool = overrides.get("tool") or self.require_tool()
        stated: dict[str, Any] = {"tool": tool, **self.interfaces(tool)} | overrides
        return Experiment(specimen, protocol, **stated)


#: Name -> kind of test.
KINDS: Registry[TestKind] = Registry("kind of test", "tissue_sim.kinds", {
    name: f"tissue_sim.experiment.kinds.{place}" for name, place in {
        "lubricated_compression": "compression:LUBRICATED", "bonded_compression": "compression:BONDED",
        "friction_compression": "compression:FRICTION", "needle_indentation": "indentation:NEEDLE",
        "uniaxial_tension": "gripped:TENSION", "simple_shear": "gripped:SHEAR"}.items()},
    accepts=lambda kind: isinstance(kind, TestKind), expected="a tissue_sim.TestKind")
