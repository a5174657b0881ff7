"""Things by name: those of the house, those of installed packages, and those that a program registers.

What can be added (a law, a tool's shape, a kind of test, a format, a device, ...) stands in a `Registry`, and everybody
who takes a name looks it up there. A package adds one through an entry point of the registry's group, a program with
`Registry.register`; nothing else has to know of it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import ModuleType
from typing import Any, Generic, TypeVar

from tissue_sim.errors import InputError, nearest

T = TypeVar("T")
#: Group -> registry, of all that were made in this process.
_ALL: dict[str, Registry] = {}
#: Group -> (name, thing) that another process has registered there, until this one makes that registry.
_WAITING: dict[str, list[tuple[str, Any]]] = {}


class Registry(Mapping[str, T], Generic[T]):
    """Name -> thing.

    Args:
        what: a thing is, in messages: ``"law"``.
        group: of the entry points that add some, such as ``"tissue_sim.laws"``.
        built_in: name -> the thing, or where it is, ``"package.module:attribute"``, which is imported on first use.
        accepts: whether a thing that somebody adds is one.
        expected: what to give where it is none, in messages.
        named_by: attribute of a thing that is its name.
    """

    def __init__(self, what: str, group: str, built_in: Mapping[str, T | str], *,
                 accepts: Callable[[Any], bool] = lambda _: True, expected: str = "", named_by: str = "name"):
        self.what, self.group, self._accepts, self._expected = what, group, accepts, expected
        self._named_by = named_by
        self._things: dict[str, T | str] = dict(built_in)
        self._built_in = frozenset(built_in)
        self._added: dict[str, T] = {}
        _ALL[group] = self
        register_all((group, name, thing) for name, thing in _WAITING.pop(group, ()))

    @cached_property
    def _installed(self) -> dict[str, EntryPoint]:
        found: dict[str, EntryPoint] = {}
        for entry in entry_points(group=self.group):
            if entry.name in self._built_in or entry.name in found:
                other = "what is built in" if entry.name in self._built_in else f"that of {found[entry.name].value}"
                raise InputError(f"the {self.what} {entry.name!r} of {entry.value} has the name of {other}; one of the "
                                 "packages has to go or take another name", field=self.group)
            found[entry.name] = entry
        return found

    def __getitem__(self, name: str) -> T:
        if name in self._things:
            thing = self._things[name]
            if isinstance(thing, str):
                module, _, attribute = thing.partition(":")
                thing = self._things[name] = getattr(import_module(module), attribute)
            return thing
        thing = self._things[name] = self._checked(name, self._installed[name].load())
        return thing

    def _checked(self, name: str, thing: T) -> T:
        if not self._accepts(thing):
            raise InputError(f"{name!r} is no {self.what}; give {self._expected}", field=self.group)
        return thing

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self._things, *self._installed)))

    def __len__(self) -> int:
        return len(set(self._things) | set(self._installed))

    def __contains__(self, name: object) -> bool:
        return name in self._things or name in self._installed

    def find(self, name: str, field: str | None = None) -> T:
        """The thing of that name.

        Args:
            name: of it.
            field: where the name stands, for the message.

        Raises:
            InputError: there is none; names the nearest.
        """
        if name not in self:
            raise InputError(f"unknown {self.what} {name!r}{nearest(str(name), self)}", field=field)
        return self[name]

    def register(self, thing: T, name: str | None = None) -> T:
        """Add a thing in this process, and in the processes that it starts for its work; returns it.

        Args:
            thing: to add.
            name: None: its attribute `named_by`.

        Raises:
            InputError: a name that is taken by another thing, or no such thing.
        """
        name = getattr(thing, self._named_by, None) if name is None else name
        if not isinstance(name, str) or not name:
            raise InputError(f"a {self.what} needs a name; give {type(thing).__name__} an attribute {self._named_by!r}",
                             field=self.group)
        if name in self:
            if self[name] is thing:
                return thing
            raise InputError(f"the name {name!r} is taken by another {self.what}; give yours another name",
                             field=self.group)
        self._things[name] = self._added[name] = self._checked(name, thing)
        return thing

    def unregister(self, name: str) -> None:
        """Take out what `register` has added.

        Raises:
            InputError: it was not registered.
        """
        if name not in self._added:
            raise InputError(f"no {self.what} {name!r} was registered in this process", field=self.group)
        del self._added[name], self._things[name]


def registered() -> list[tuple[str, str, Any]]:
    """(group, name, thing) of all that was registered in this process; for `register_all` in another."""
    return [(group, name, thing) for group, registry in _ALL.items() for name, thing in registry._added.items()]


def modules_of_additions() -> dict[str, ModuleType]:
    """Name -> module of every thing in use here that is not built in: what was registered, and what installed packages
    add as far as it was looked up. What a program computes depends on their source too."""
    things = [thing for registry in _ALL.values() for name, thing in registry._things.items()
              if name not in registry._built_in]
    names = {getattr(thing, "__module__", None) for thing in things}
    return {name: sys.modules[name] for name in sorted(name for name in names if name in sys.modules)}


def register_all(things: Iterable[tuple[str, str, Any]]) -> None:
    """Register what another process has, at once or when the registry is made here; what is there under its name
    already stays."""
    for group, name, thing in things:
        if group not in _ALL:
            _WAITING.setdefault(group, []).append((name, thing))
        elif name not in _ALL[group]:
            _ALL[group].register(thing, name)
