"""Registries: built-in objects, those of installed packages, and those that a program registers, by name.

Everything that can be added (a law, the shape of a tool, a kind of test, a format, a device, ...) has a `Registry`, in
which all code looks up its names. A package adds an object through an entry point of the registry's group, a program
with `Registry.register`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import ModuleType
from typing import Any, Generic, TypeVar

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words

T = TypeVar("T")
#: Group -> registry, for all registries of this process.
_ALL: dict[str, Registry] = {}
#: Group -> (name, object) from another process, until the registry of the group is made in this process.
_WAITING: dict[str, list[tuple[str, Any]]] = {}


class Registry(Mapping[str, T], Generic[T]):
    """Mapping from names to objects.

    Args:
        what: kind of object, for messages: ``"law"``.
        group: group of the entry points that add objects, such as ``"tissue_sim.laws"``.
        built_in: name -> object, or its import path ``"package.module:attribute"``, which is imported on first use.
        accepts: whether an added object is valid.
        expected: description of a valid object, for messages.
        named_by: attribute of an object that is its name.
        is_used_in_tasks: whether tasks in other processes use the objects, and results depend on their source. Objects
            that only present results or distribute tasks stay in this process.
        aliases: alias -> name of the object. Iteration yields names, not aliases.
    """

    def __init__(self, what: str, group: str, built_in: Mapping[str, T | str], *,
                 accepts: Callable[[Any], bool] = lambda _: True, expected: str = "", named_by: str = "name",
                 is_used_in_tasks: bool = True, aliases: Mapping[str, str] | None = None):
        self.what, self.group, self._accepts, self._expected = what, group, accepts, expected
        self._named_by, self.is_used_in_tasks = named_by, is_used_in_tasks
        self._things: dict[str, T | str] = dict(built_in)
        self._aliases = dict(aliases or {})
        self._built_in = frozenset((*built_in, *self._aliases))
        self._added: dict[str, T] = {}
        _ALL[group] = self
        register_objects_of_other_process((group, name, thing) for name, thing in _WAITING.pop(group, ()))

    @cached_property
    def _installed_entry_points(self) -> dict[str, EntryPoint]:
        """Name -> entry point of the group in installed packages; a name that occurs twice is an InputError."""
        found: dict[str, EntryPoint] = {}
        for entry in entry_points(group=self.group):
            if entry.name in self._built_in or entry.name in found:
                other = "a built-in one" if entry.name in self._built_in else f"that of {found[entry.name].value}"
                raise InputError(f"the {self.what} {entry.name!r} of {entry.value} has the name of {other}; remove or "
                                 "rename one of them", field=self.group)
            found[entry.name] = entry
        return found

    def get_name_of_alias(self, name: str) -> str:
        """Return the name of the object with this name or alias; an unknown name is returned unchanged."""
        return self._aliases.get(name, name)

    def __getitem__(self, name: str) -> T:
        name = self.get_name_of_alias(name)
        if name in self._things:
            thing = self._things[name]
            if isinstance(thing, str):
                module, _, attribute = thing.partition(":")
                thing = self._things[name] = getattr(import_module(module), attribute)
            return thing
        thing = self._things[name] = self._require_and_return_valid_entry(name,
                                                                          self._installed_entry_points[name].load())
        return thing

    def _require_and_return_valid_entry(self, name: str, thing: T) -> T:
        """Return the object if it is valid for this registry; else raise an InputError."""
        if not self._accepts(thing):
            raise InputError(f"{name!r} is not a valid {self.what}; give {self._expected}", field=self.group)
        return thing

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self._things, *self._installed_entry_points)))

    def __len__(self) -> int:
        return len(set(self._things) | set(self._installed_entry_points))

    def __contains__(self, name: object) -> bool:
        return name in self._aliases or name in self._things or name in self._installed_entry_points

    def find(self, name: str, field: str | None = None) -> T:
        """Return the object with a name.

        Args:
            name: name or alias of the object.
            field: field that contains the name, for the message.

        Raises:
            InputError: no object has the name; the message names the nearest.

        Examples:
            >>> from tissue_sim.experiment.tools.tool import TOOLS
            >>> TOOLS.find("flat").name
            'flat'
        """
        if name not in self:
            hint = make_hint_with_similar_or_known_words(str(name), (*self, *self._aliases))
            raise InputError(f"unknown {self.what} {name!r}{hint}", field=field)
        return self[name]

    def register(self, thing: T, name: str | None = None) -> T:
        """Add an object in this process and in the worker processes that it starts, and return the object.

        Args:
            thing: object to add.
            name: None: its attribute `named_by`.

        Raises:
            InputError: another object has the name, or the object is not valid.
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
        self._things[name] = self._added[name] = self._require_and_return_valid_entry(name, thing)
        return thing

    def unregister(self, name: str) -> None:
        """Remove an object that `register` has added.

        Raises:
            InputError: no object of this name was registered.
        """
        if name not in self._added:
            raise InputError(f"{name!r} cannot be removed: this process has registered no {self.what} of this name; "
                             "only entries that register() added can be removed", field=self.group)
        del self._added[name], self._things[name]


def list_registered_groups_names_objects() -> list[tuple[str, str, Any]]:
    """Return (group, name, object) of the registered objects of this process that tasks use.

    `register_objects_of_other_process` registers these objects in another process.
    """
    return [(group, name, thing) for group, registry in _ALL.items() if registry.is_used_in_tasks
            for name, thing in registry._added.items()]


def get_modules_of_additions_by_name() -> dict[str, ModuleType]:
    """Return name -> module of the objects that tasks use and that are not built in: registered or of packages.

    Results of a program depend on the source of these modules.
    """
    things = [thing for registry in _ALL.values() if registry.is_used_in_tasks
              for name, thing in registry._things.items() if name not in registry._built_in]
    names = {getattr(thing, "__module__", None) for thing in things}
    return {name: sys.modules[name] for name in sorted(name for name in names if name in sys.modules)}


def register_objects_of_other_process(things: Iterable[tuple[str, str, Any]]) -> None:
    """Register objects of another process, at once or when their registry is made; existing names are kept."""
    for group, name, thing in things:
        if group not in _ALL:
            _WAITING.setdefault(group, []).append((name, thing))
        elif name not in _ALL[group]:
            _ALL[group].register(thing, name)
