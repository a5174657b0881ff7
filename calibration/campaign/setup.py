"""How a test of a campaign is done: tool, interfaces and rig, and which of them its kind allows."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from calibration.campaign.checks import HOMOGENEOUS
from calibration.campaign.schema import TestTable
from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Experiment, Specimen, checked_interface
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.experiment.tools.tool import TOOLS, Tool, read_shape, sizes_of_keys, tool_sizes
from tissue_sim.rig.file import load_rig
from tissue_sim.rig.rig import Rig

#: Kind of test -> interfaces of the tool's face and of the base where nothing else is said; None: it must be said.
_FACES: dict[str, tuple[str | None, str | None]] = {
    "lubricated_compression": ("frictionless", "frictionless"), "bonded_compression": ("bonded", "bonded"),
    "friction_compression": (None, None), "needle_indentation": ("bonded", "bonded"),
}
#: Kinds whose interfaces are what their name says.
_FIXED_FACES = ("lubricated_compression", "bonded_compression")
#: Field of an experiment or a tool -> key of the campaign.
_KEYS = {"tool": "tool", "tool.profile_file": "tool",
         "friction": "friction", "friction_base": "friction_base", "friction_wall": "friction_wall"}


@dataclass(frozen=True)
class Setup:
    """Everything of an `Experiment` and a `Model` that a campaign's test states, but its specimen and its motion.

    Attributes:
        tool: what is pushed in. friction, friction_base, friction_wall: interfaces, as in `Experiment`.
        rig: what stands between the tissue and the recording; without noise and resolution.
    """

    tool: Tool = field(default_factory=Tool)
    friction: str | float = "frictionless"
    friction_base: str | float = "frictionless"
    friction_wall: str | float = "frictionless"
    rig: Rig = field(default_factory=Rig)

    def __post_init__(self):
        for name in ("friction", "friction_base", "friction_wall"):
            object.__setattr__(self, name, checked_interface(getattr(self, name), name))

    @property
    def slides(self) -> bool:
        """Whether tissue may slip against friction, so that the force depends on the way."""
        return any(isinstance(value, float) for value in (self.friction, self.friction_base, self.friction_wall))

    def experiment(self, specimen: Specimen, protocol: Protocol) -> Experiment:
        """The experiment of this test on a specimen.

        Raises:
            InputError: what `Experiment` refuses.
        """
        return Experiment(specimen, protocol, self.tool, self.friction, self.friction_base, self.friction_wall)


def read_setup(entry: TestTable, specimen: Specimen | None, folder: Path, place: str) -> Setup | None:
    """The set-up of a test; None of tension and shear, which have neither tool nor base.

    Args:
        entry: of the campaign. specimen: that it names. folder: that its files are relative to. place: its field.

    Raises:
        InputError: keys that do not fit the kind or each other, with the field of the campaign.
    """
    if entry.kind not in _FACES:
        for key in (*entry.tool_sizes, "friction", "friction_base", "friction_wall", "rig"):
            if getattr(entry, key) is not None:
                raise InputError(f"a test of kind {entry.kind!r} is gripped on both sides and has none; leave it out",
                                 field=f"{place}.{key}")
        if entry.tool != "plate":
            raise InputError(f"a test of kind {entry.kind!r} has no tool; leave it out", field=f"{place}.tool")
        return None
    friction, friction_base = (_face(entry, key, default, place)
                               for key, default in zip(("friction", "friction_base"), _FACES[entry.kind], strict=True))
    try:
        setup = Setup(_tool(entry, folder, place), friction, friction_base,
                      "frictionless" if entry.friction_wall is None else entry.friction_wall,
                      _rig(entry, folder, place))
        # With a short way, so that only what is wrong with the set-up is found.
        probe = Specimen(1.0, 1.0) if specimen is None else specimen
        setup.experiment(probe, Protocol.ramp(1e-3 * probe.height, 2))
    except InputError as error:
        keys = _KEYS | {f"tool.{name}": key for key, (_, name, _) in tool_sizes().items()}
        if error.field not in keys:
            raise
        raise InputError(error.problem.replace("give the tool an edge radius", "give edge_radius_mm"),
                         field=f"{place}.{keys[error.field]}") from None
    return setup


def _face(entry: TestTable, key: str, default: str | None, place: str) -> str | float:
    value = getattr(entry, key)
    if entry.kind in _FIXED_FACES and value is not None and (value or "frictionless") != default:
        raise InputError(f"{value!r} contradicts kind = {entry.kind!r}, whose faces are {default}; leave it out, or "
                         "use kind = 'friction_compression'", field=f"{place}.{key}")
    if value is None and default is None:
        raise InputError("friction_compression needs the interface of both plates; give a coefficient of friction, "
                         "'stick', 'frictionless' or 'bonded'", field=f"{place}.{key}")
    return default if value is None else value


def _tool(entry: TestTable, folder: Path, place: str) -> Tool:
    shape, profile = read_shape(entry.tool, folder)
    TOOLS.find(shape, f"{place}.tool")
    if entry.kind == "needle_indentation" and entry.tool == "plate":
        raise InputError("needle_indentation needs the shape of its tool: tool = 'flat', 'round', 'cone', 'sphere' or "
                         "a profile file", field=f"{place}.tool")
    if entry.kind != "needle_indentation" and entry.tool != "plate":
        raise InputError(f"{entry.kind} is done with a plate, not with {entry.tool!r}; use kind = 'needle_indentation'",
                         field=f"{place}.tool")
    # A zero says that the tool has no such size.
    sizes = sizes_of_keys({key: value for key, value in entry.tool_sizes.items() if value})
    return Tool(shape, profile_file=profile, **sizes)


def _rig(entry: TestTable, folder: Path, place: str) -> Rig:
    """The rig of the test's file; what it does to single samples is in the recording, not in the model."""
    if entry.rig is None:
        return Rig()
    try:
        rig = load_rig(folder / entry.rig)
    except InputError as error:
        raise error.located(field=f"{place}.rig") from None
    return Rig(**{name: getattr(rig, name) for name in (
        "contact_offset", "displacement_gain", "backlash", "step_loss", "step_loss_depth", "compliance",
        "guide_friction", "rate_damping", "latency", "sensor_gain", "zero_offset", "sensor_drift")})


def check_homogeneous(kind: str, specimen: Specimen | None, place: str) -> None:
    """Refuse a test that needs a specimen and has none."""
    if specimen is None and kind not in HOMOGENEOUS:
        raise InputError(f"{kind} is simulated on its specimen; add a [[specimen]] and name it here",
                         field=f"{place}.specimen")
