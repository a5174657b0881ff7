"""The configuration commands of a server: one line of JSON in, one line of JSON out."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any

import msgspec
import numpy as np

from haptics.server.steps import StepService
from haptics.server.wire import FRAME, REPLY_SIZE, REQUEST_SIZE, VERSION
from tissue_sim.decode import as_json_types, decode
from tissue_sim.errors import ConvergenceError, InputError, nearest

MOST_STATES, MOST_SEGMENTS = 16, 256
#: Rows of an array that are turned into JSON between two looks at the poses.
_ROWS = 128
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


class _Command(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    command: str


class _SetParameters(_Command, frozen=True):
    parameters: dict[str, float]


class _Surface(_Command, frozen=True):
    segments: Annotated[int, msgspec.Meta(ge=3, le=MOST_SEGMENTS)] | None = None


class _State(_Command, frozen=True):
    name: Name


Description = Mapping[str, Any] | Callable[[], Mapping[str, Any]]


class Commands:
    """Executes the commands on the tissue of a `StepService`, between its steps.

    Args:
        service: the tissue, and who owns it.
        description: what ``describe`` says of scene, specimen, tool, material and mesh; of JSON's types, or what gives
            it when it is asked for.
        parameters: name -> value of those that ``set_parameters`` knows, SI.
    """

    def __init__(self, service: StepService, description: Description | None = None,
                 parameters: Mapping[str, float] | None = None):
        self._service, self._began = service, service.tissue
        self._description = description if callable(description) else as_json_types(description or {})
        #: Of the tissue that it began with, and of the one that there is now.
        self._first = dict(parameters or {})
        self._parameters = dict(self._first)
        self._states: dict[str, tuple[Any, dict[str, float]]] = {}
        self._commands: dict[str, tuple[type[_Command], Callable[[Any], Iterator[bytes] | dict[str, Any]]]] = {
            "describe": (_Command, self._describe),
            "statistics": (_Command, self._statistics),
            "reset": (_Command, self._reset),
            "set_parameters": (_SetParameters, self._set_parameters),
            "surface": (_Surface, self._surface),
            "save": (_State, self._save),
            "restore": (_State, self._restore),
        }

    def execute(self, line: bytes) -> Iterator[bytes]:
        """Execute one command.

        Args:
            line: JSON, without the line end.

        Returns:
            The answer in pieces that are quick to make, its line end included; ``{"error": sentence}`` where the
            command is none.

        Raises:
            ConnectionAbortedError: the line is of HTTP: a web page must not get as far as the next line.
        """
        if re.search(rb"HTTP/\d", line[-16:]):
            raise ConnectionAbortedError("a browser")
        try:
            answer = self._execute(line)
        except (InputError, ConvergenceError) as error:
            answer = {"error": str(error)}
        except Exception as error:
            # Whatever a tissue does, the poses are answered on.
            self._service.log(f"a command failed ({type(error).__name__}: {str(error)[:200]})")
            answer = {"error": f"the command failed ({type(error).__name__}); the server's log says why"}
        if isinstance(answer, dict):
            return iter((msgspec.json.encode(answer) + b"\n",))
        return answer

    def _execute(self, line: bytes) -> Iterator[bytes] | dict[str, Any]:
        try:
            asked = msgspec.json.decode(line)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise InputError(f'not JSON ({error}); send one object a line, such as {{"command": "describe"}}') from None
        name = asked.get("command") if isinstance(asked, dict) else None
        if not isinstance(name, str):
            raise InputError(f"is missing; give one of {', '.join(self._commands)}", field="command")
        if name not in self._commands:
            raise InputError(f"unknown command {name[:64]!r}{nearest(name[:64], self._commands)}", field="command")
        kind, run = self._commands[name]
        if self._service.tissue is not self._began:
            # Built anew after a failure, as at first.
            self._began, self._parameters = self._service.tissue, dict(self._first)
        answer = run(decode(asked, kind))
        return {"command": name, **answer} if isinstance(answer, dict) else answer

    def _describe(self, _: _Command) -> dict[str, Any]:
        given = as_json_types(self._description()) if callable(self._description) else self._description
        return {"protocol": {"version": VERSION, "request_bytes": REQUEST_SIZE, "reply_bytes": REPLY_SIZE},
                "frame": FRAME, **given, "parameters": self._parameters,
                "commands": list(self._commands), "states": list(self._states)}

    def _statistics(self, _: _Command) -> dict[str, Any]:
        owner = self._service.owner
        return {**msgspec.to_builtins(self._service.counters),
                "owner": None if owner is None else "{}:{}".format(*owner[:2])}

    def _reset(self, _: _Command) -> dict[str, Any]:
        self._service.tissue.reset()
        self._service.begin_anew()
        return {}

    def _set_parameters(self, asked: _SetParameters) -> dict[str, Any]:
        for name in asked.parameters:
            if name not in self._parameters:
                hint = nearest(name[:64], self._parameters) if self._parameters else "; this tissue has none to set"
                raise InputError(f"unknown parameter{hint}", field=f"parameters.{name[:64]}")
        self._able("set_parameters")(**asked.parameters)
        self._parameters |= asked.parameters
        return {"parameters": self._parameters}

    def _surface(self, asked: _Surface) -> Iterator[bytes]:
        surface = self._able("surface")()
        arrays = {} if surface.outline is None else {"outline": surface.outline}
        if asked.segments is not None:
            arrays["vertices"], arrays["triangles"] = surface.triangles(asked.segments)
        return _in_pieces("surface", arrays)

    def _save(self, asked: _State) -> dict[str, Any]:
        if asked.name not in self._states and len(self._states) == MOST_STATES:
            raise InputError(f"{MOST_STATES} states are kept already; save under one of their names: "
                             f"{', '.join(self._states)}", field="name")
        self._states[asked.name] = (self._able("save")(), dict(self._parameters))
        return {"states": list(self._states)}

    def _restore(self, asked: _State) -> dict[str, Any]:
        if asked.name not in self._states:
            hint = nearest(asked.name, self._states) if self._states else "; none was saved"
            raise InputError(f"no state {asked.name!r} was saved{hint}", field="name")
        state, parameters = self._states[asked.name]
        if parameters != self._parameters:
            self._able("set_parameters")(**parameters)
            self._parameters = dict(parameters)
        self._able("restore")(state)
        self._service.begin_anew()
        return {"parameters": self._parameters}

    def _able(self, ability: str) -> Callable[..., Any]:
        method = getattr(self._service.tissue, ability, None)
        if method is None:
            raise InputError(f"this tissue cannot {ability}; serve a tissue_sim.Simulator", field="command")
        return method


def _in_pieces(command: str, arrays: Mapping[str, np.ndarray]) -> Iterator[bytes]:
    """A JSON object of arrays, some rows at a time."""
    yield b'{"command":' + msgspec.json.encode(command)
    for name, rows in arrays.items():
        yield b"," + msgspec.json.encode(name) + b":["
        for start in range(0, len(rows), _ROWS):
            piece = msgspec.json.encode(rows[start:start + _ROWS].tolist())[1:-1]
            yield b"," + piece if start else piece
        yield b"]"
    yield b"}\n"
