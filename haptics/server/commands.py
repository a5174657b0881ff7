"""Configuration port of a server: TCP connections, and commands of one line of JSON with answers of one line each.

The connections send and receive lines in small pieces between two steps.
"""

from __future__ import annotations

import re
import selectors
import socket
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np

from haptics.server.steps import StepService
from haptics.server.wire import FRAME, REPLY_SIZE, REQUEST_SIZE, VERSION
from tissue_sim.decode import convert_to_json_types, decode_struct
from tissue_sim.errors import ConvergenceError, InputError, make_hint_with_similar_or_known_words


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits of the configuration port.

    Attributes:
        longest_line: largest length of a line, bytes; a longer line gets an error.
        read_size: largest number of bytes of one read.
        most_connections: largest number of open connections; a further connection closes the one idle for longest.
        stalled: time after which a connection with an unfinished line or an unread answer is closed, s.
        idle: time after which a connection without traffic is closed, s.
    """

    longest_line: int = 65536
    read_size: int = 65536
    most_connections: int = 8
    stalled: float = 10.0
    idle: float = 600.0


#: Limits of every configuration port.
CONNECTION_LIMITS = ConnectionLimits()

_TOO_LONG = (b'{"error":"a line must have at most %d bytes; send one short command per line"}\n'
             % CONNECTION_LIMITS.longest_line)

Execute = Callable[[bytes], Iterator[bytes]]


class ConfigurationPort:
    """Accept TCP connections, and answer their lines.

    `accept_and_evict_idle_connection` and the connections do one piece of work per call and never wait. The owner of
    the selector decides when to call.

    Args:
        listener: bound and listening socket.
        execute: function that returns the answer to a line in pieces; it raises ConnectionAbortedError to close the
            connection.
        selector: selector at which the sockets are registered; the data of each socket is the function that serves the
            socket, with the time, s, as its argument.
    """

    def __init__(self, listener: socket.socket, execute: Execute, selector: selectors.BaseSelector):
        self._listener, self._execute, self._selector = listener, execute, selector
        self._connections: set[_ConfigurationConnection] = set()
        listener.setblocking(False)
        selector.register(listener, selectors.EVENT_READ, self.accept_and_evict_idle_connection)

    def accept_and_evict_idle_connection(self, now: float) -> None:
        """Accept one connection; if there are too many, close the connection that was idle for longest.

        Args:
            now: time on the clock of the server, s.
        """
        try:
            peer, _ = self._listener.accept()
        except OSError:  # The client has disconnected, or the process has no free file descriptor.
            return
        if len(self._connections) == CONNECTION_LIMITS.most_connections:
            min(self._connections, key=lambda connection: connection.last_traffic).close()
        self._connections.add(_ConfigurationConnection(peer, self._execute, self._selector, self._connections.discard,
                                                       now))

    def close_stalled_and_idle_connections(self, now: float) -> None:
        """Close the connections without traffic, see `ConnectionLimits.stalled` and `ConnectionLimits.idle`.

        Args:
            now: time on the clock of the server, s.
        """
        for connection in [*self._connections]:
            limit = CONNECTION_LIMITS.stalled if connection.is_busy else CONNECTION_LIMITS.idle
            if now - connection.last_traffic > limit:
                connection.close()

    def close(self) -> None:
        """Close the port and all connections."""
        for connection in [*self._connections]:
            connection.close()
        self._selector.unregister(self._listener)
        self._listener.close()


class _ConfigurationConnection:
    """One TCP connection to the configuration port; it is read only while no answer is pending, so that no queue grows.

    Attributes:
        last_traffic: time at which bytes were last received or sent, s.
    """

    def __init__(self, peer: socket.socket, execute: Execute, selector: selectors.BaseSelector,
                 on_close: Callable[[_ConfigurationConnection], None], now: float):
        self._peer, self._execute, self._selector = peer, execute, selector
        self._on_close, self.last_traffic = on_close, now
        self._inbox, self._outbox = bytearray(), b""
        self._answer: Iterator[bytes] | None = None
        #: Whether the rest of a line that exceeds the limit is being discarded.
        self._too_long = False
        peer.setblocking(False)
        self._interest = selectors.EVENT_READ
        selector.register(peer, self._interest, self.serve_connection_once)

    @property
    def is_busy(self) -> bool:
        """Whether a line is incomplete, or an answer is not fully sent."""
        return bool(self._inbox or self._too_long or self._outbox or self._answer)

    def serve_connection_once(self, now: float) -> None:
        """Do one piece of work: receive bytes, execute a line, compute a piece of the answer, or send bytes.

        Args:
            now: time on the clock of the server, s.
        """
        try:
            self._do_next_work_piece(now)
        except BlockingIOError:
            return
        except OSError:  # The client has disconnected, or `execute` closes the connection.
            self.close()
            return
        ready = self._outbox or self._answer is not None or b"\n" in self._inbox
        interest = selectors.EVENT_WRITE if ready else selectors.EVENT_READ
        if interest != self._interest:
            self._interest = interest
            self._selector.modify(self._peer, interest, self.serve_connection_once)

    def close(self) -> None:
        """Close the connection; bytes that were not sent are lost."""
        self._selector.unregister(self._peer)
        self._peer.close()
        self._on_close(self)

    def _do_next_work_piece(self, now: float) -> None:
        """Receive bytes, execute one line, or send a part of its answer; OSError: the client has disconnected."""
        if not self._outbox and self._answer is None:
            if b"\n" not in self._inbox:
                received = self._peer.recv(CONNECTION_LIMITS.read_size)
                if not received:
                    raise ConnectionResetError
                self.last_traffic = now
                self._inbox += received
            line, end, _ = self._inbox.partition(b"\n")
            if end:
                del self._inbox[:len(line) + 1]
                if self._too_long or len(line) > CONNECTION_LIMITS.longest_line:
                    self._answer = iter((_TOO_LONG,))
                elif line.strip():
                    self._answer = self._execute(bytes(line))
                self._too_long = False
            elif len(line) > CONNECTION_LIMITS.longest_line:
                self._inbox.clear()
                self._too_long = True
        if not self._outbox and self._answer is not None:
            self._outbox = next(self._answer, b"")
            if not self._outbox:
                self._answer = None
        if self._outbox:
            sent = self._peer.send(self._outbox)
            self.last_traffic = now
            self._outbox = self._outbox[sent:]


@dataclass(frozen=True)
class SavedStateAndSurfaceLimits:
    """Limits of commands that keep or return large data.

    Attributes:
        max_states: largest number of saved states.
        max_segments: largest number of circumferential segments of a surface.
        rows_per_piece: rows of an array that are encoded in one piece; the server answers poses between two pieces.
            Smaller pieces delay these answers less.
    """

    max_states: int = 16
    max_segments: int = 256
    rows_per_piece: int = 128


#: Limits of every server.
STATE_LIMITS = SavedStateAndSurfaceLimits()
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


class _ConfigurationCommand(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Command without arguments; base class of the commands with arguments."""

    command: str


class _SetParametersCommand(_ConfigurationCommand, frozen=True):
    """Arguments of ``set_parameters``: name -> value, SI units."""

    parameters: dict[str, float]


class _SurfaceCommand(_ConfigurationCommand, frozen=True):
    """Arguments of ``surface``: circumferential segments of the triangles; None: no triangles."""

    segments: Annotated[int, msgspec.Meta(ge=3, le=STATE_LIMITS.max_segments)] | None = None


class _NamedStateCommand(_ConfigurationCommand, frozen=True):
    """Arguments of ``save`` and ``restore``: name of the state."""

    name: Name


Description = Mapping[str, Any] | Callable[[], Mapping[str, Any]]


class ConfigurationCommands:
    """Execute configuration commands on the tissue of a `StepService`, between its steps.

    Args:
        service: service that owns the tissue.
        description: entries of the answer to ``describe`` about scene, specimen, tool, material and mesh, of JSON
            types; or a function that returns them at the time of the command.
        parameters: name -> value of each parameter that ``set_parameters`` accepts, SI units.
    """

    def __init__(self, service: StepService, description: Description | None = None,
                 parameters: Mapping[str, float] | None = None):
        self._service, self._tissue = service, service.tissue
        self._description = description if callable(description) else convert_to_json_types(description or {})
        #: Parameters of the initial tissue.
        self._initial_parameters = dict(parameters or {})
        #: Parameters of the present tissue.
        self._parameters = dict(self._initial_parameters)
        self._states: dict[str, tuple[Any, dict[str, float]]] = {}
        self._commands: dict[str, tuple[type[_ConfigurationCommand],
                                        Callable[[Any], Iterator[bytes] | dict[str, Any]]]] = {
            "describe": (_ConfigurationCommand, self._describe_server),
            "statistics": (_ConfigurationCommand, self._collect_statistics),
            "reset": (_ConfigurationCommand, self._reset_tissue),
            "set_parameters": (_SetParametersCommand, self._set_parameters),
            "surface": (_SurfaceCommand, self._encode_outline_and_triangles),
            "save": (_NamedStateCommand, self._save_state_and_parameters),
            "restore": (_NamedStateCommand, self._restore_state_and_parameters),
        }

    def execute(self, line: bytes) -> Iterator[bytes]:
        """Execute one command, and return its answer as a line of JSON.

        Args:
            line: JSON object, without the line end.

        Returns:
            The answer with its line end, in pieces that are quick to compute. A failed or unknown command gives
            ``{"error": sentence}``.

        Raises:
            ConnectionAbortedError: the line is HTTP. The connection must be closed, so that a web page cannot send a
                command in a later line of its request.
        """
        if re.search(rb"HTTP/\d", line[-16:]):
            raise ConnectionAbortedError("the client is a web browser")
        try:
            answer = self._decode_and_execute(line)
        except (InputError, ConvergenceError) as error:
            answer = {"error": str(error)}
        except Exception as error:
            # An error of a tissue must not end the server, which still answers poses.
            self._service.log(f"a command failed ({type(error).__name__}: {str(error)[:200]})")
            answer = {"error": f"the command failed ({type(error).__name__}); see the log of the server for the reason"}
        if isinstance(answer, dict):
            return iter((msgspec.json.encode(answer) + b"\n",))
        return answer

    def _decode_and_execute(self, line: bytes) -> Iterator[bytes] | dict[str, Any]:
        """Decode a line, execute its command, and return its JSON object or an iterator of encoded pieces."""
        try:
            request = msgspec.json.decode(line)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise InputError(f'the line must be JSON ({error}); send one object per line, such as '
                             '{"command": "describe"}') from None
        name = request.get("command") if isinstance(request, dict) else None
        if not isinstance(name, str):
            raise InputError(f"the command must be one of {', '.join(self._commands)}; got none", field="command")
        if name not in self._commands:
            raise InputError(
                f"unknown command {name[:64]!r}{make_hint_with_similar_or_known_words(name[:64], self._commands)}",
                field="command")
        kind, function = self._commands[name]
        if self._service.tissue is not self._tissue:
            # The service has rebuilt the tissue after a failure, with the initial parameters.
            self._tissue, self._parameters = self._service.tissue, dict(self._initial_parameters)
        answer = function(decode_struct(request, kind))
        return {"command": name, **answer} if isinstance(answer, dict) else answer

    def _describe_server(self, _: _ConfigurationCommand) -> dict[str, Any]:
        """Return protocol, frame, scene, parameters, commands and saved states."""
        description = convert_to_json_types(self._description()) if callable(self._description) else self._description
        return {"protocol": {"version": VERSION, "request_bytes": REQUEST_SIZE, "reply_bytes": REPLY_SIZE},
                "frame": FRAME, **description, "parameters": self._parameters,
                "commands": list(self._commands), "states": list(self._states)}

    def _collect_statistics(self, _: _ConfigurationCommand) -> dict[str, Any]:
        """Return the counters of packets and steps, and the address of the client that owns the tissue."""
        owner = self._service.owner_address
        return {**msgspec.to_builtins(self._service.counters),
                "owner": None if owner is None else "{}:{}".format(*owner[:2])}

    def _reset_tissue(self, _: _ConfigurationCommand) -> dict[str, Any]:
        """Restore the undeformed state of the tissue, and return an empty object."""
        self._service.tissue.reset()
        self._service.clear_last_step_record()
        return {}

    def _set_parameters(self, request: _SetParametersCommand) -> dict[str, Any]:
        """Change parameters of the tissue, and return all parameters."""
        for name in request.parameters:
            if name not in self._parameters:
                hint = make_hint_with_similar_or_known_words(name[:64], self._parameters) if self._parameters else \
                    "; this tissue has no parameters to set"
                raise InputError(f"unknown parameter{hint}", field=f"parameters.{name[:64]}")
        self._get_tissue_method("set_parameters")(**request.parameters)
        self._parameters |= request.parameters
        return {"parameters": self._parameters}

    def _encode_outline_and_triangles(self, request: _SurfaceCommand) -> Iterator[bytes]:
        """Yield the deformed surface as an outline and, on request, as triangles."""
        surface = self._get_tissue_method("surface")()
        arrays = {} if surface.outline is None else {"outline": surface.outline}
        if request.segments is not None:
            arrays["vertices"], arrays["triangles"] = surface.triangles(request.segments)
        return _iterate_json_pieces_of_arrays("surface", arrays)

    def _save_state_and_parameters(self, request: _NamedStateCommand) -> dict[str, Any]:
        """Save state and parameters of the tissue under a name, and return the names of all saved states."""
        if request.name not in self._states and len(self._states) == STATE_LIMITS.max_states:
            raise InputError(f"at most {STATE_LIMITS.max_states} states can be saved; save under an existing name: "
                             f"{', '.join(self._states)}", field="name")
        self._states[request.name] = (self._get_tissue_method("save")(), dict(self._parameters))
        return {"states": list(self._states)}

    def _restore_state_and_parameters(self, request: _NamedStateCommand) -> dict[str, Any]:
        """Restore the state and the parameters that were saved under a name, and return all parameters."""
        if request.name not in self._states:
            hint = make_hint_with_similar_or_known_words(request.name, self._states) if self._states \
                else "; no state was saved"
            raise InputError(f"unknown state {request.name!r}{hint}", field="name")
        state, parameters = self._states[request.name]
        if parameters != self._parameters:
            self._get_tissue_method("set_parameters")(**parameters)
            self._parameters = dict(parameters)
        self._get_tissue_method("restore")(state)
        self._service.clear_last_step_record()
        return {"parameters": self._parameters}

    def _get_tissue_method(self, name: str) -> Callable[..., Any]:
        """Return a method of the tissue.

        Args:
            name: name of the method.

        Raises:
            InputError: the tissue does not have this method.
        """
        method = getattr(self._service.tissue, name, None)
        if method is None:
            raise InputError(f"this tissue does not support {name!r}; serve a tissue_sim.Simulator", field="command")
        return method


def _iterate_json_pieces_of_arrays(command: str, arrays: Mapping[str, np.ndarray]) -> Iterator[bytes]:
    """Yield a JSON object of arrays in pieces of at most `SavedStateAndSurfaceLimits.rows_per_piece` rows.

    Args:
        command: value of the key ``command``.
        arrays: key -> array, shape (rows, columns).
    """
    yield b'{"command":' + msgspec.json.encode(command)
    for name, rows in arrays.items():
        yield b"," + msgspec.json.encode(name) + b":["
        for start in range(0, len(rows), STATE_LIMITS.rows_per_piece):
            piece = msgspec.json.encode(rows[start:start + STATE_LIMITS.rows_per_piece].tolist())[1:-1]
            yield b"," + piece if start else piece
        yield b"]"
    yield b"}\n"
