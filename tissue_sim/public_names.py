"""Public names: lazy imports of packages and modules; old names that give a `DeprecationWarning` for one release."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar, cast

if TYPE_CHECKING:
    from importlib.abc import Loader

_Class = TypeVar("_Class", bound=type)


def make_lazy_package_members(package: str, renamed: Mapping[str, str] | None = None,
                              moved: Mapping[str, str] | None = None
                              ) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Make ``__all__``, ``__getattr__`` and ``__dir__`` of a package that imports each public name on first use.

    Args:
        package: ``__name__`` of the package. The folder of the package contains ``__init__.pyi``, which type checkers
            read, with one line ``from MODULE import NAME as NAME`` for each public name.
        renamed: old name -> new name. An old name gives a `DeprecationWarning` and the member with the new name.
        moved: old name -> new name of modules, see `MovedModules`.

    Source: PEP 562.
    """
    if moved:
        sys.meta_path.append(MovedModules(moved))
    homes = {}
    spec: Any = sys.modules[package].__spec__
    # The loader of the package reads the stub, so that packages in a zip archive work too.
    for line in spec.loader.get_data(f"{spec.origin}i").decode("utf-8").splitlines():
        match line.split():
            case "from", module, "import", name, "as", _:
                homes[name] = module

    def import_public_name(name: str) -> Any:
        """Import the module of a public name and return the member, which is stored in the package."""
        if renamed and name in renamed:
            warnings.warn(f"{package}.{name} is renamed to {package}.{renamed[name]}", DeprecationWarning, stacklevel=2)
            return getattr(sys.modules[package], renamed[name])
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(homes[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    def list_names() -> list[str]:
        """Return the names of the package's namespace and its public names, sorted."""
        return sorted({*vars(sys.modules[package]), *homes})

    return sorted(homes), import_public_name, list_names


class LazyModule(ModuleType):
    """Module that is imported when one of its attributes is read; ``__name__`` is the name of the module."""

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self.__name__), name)


def make_getattr_for_old_names(module: str, renamed: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a ``__getattr__`` of a module that answers old names with a `DeprecationWarning`.

    Args:
        module: ``__name__`` of the module.
        renamed: old name -> new name, or ``"other.module:new_name"``.

    Example:
        ``__getattr__ = make_getattr_for_old_names(__name__, {"Rung": "ResolutionLevel"})``
    """
    def get_member_by_old_name(name: str) -> Any:
        """Warn that the name is renamed, and return the member with the new name."""
        if name not in renamed:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        place, _, new = renamed[name].rpartition(":")
        warnings.warn(f"{module}.{name} is renamed to {place or module}.{new}", DeprecationWarning, stacklevel=2)
        return getattr(import_module(place or module), new)

    return get_member_by_old_name


class MovedModules:
    """Finder that imports modules by their old names; reading a member gives a `DeprecationWarning`.

    Args:
        moved: old name -> new name of each module.

    Source: PEP 451.

    Example:
        ``sys.meta_path.append(MovedModules({"tissue_sim.simulator": "tissue_sim.realtime.simulator"}))``
    """

    def __init__(self, moved: Mapping[str, str]):
        self._moved = moved

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the specification of a module by its old name; None for other names."""
        return ModuleSpec(name, cast("Loader", self)) if name in self._moved else None

    def create_module(self, spec: ModuleSpec) -> None:
        """Return None: the import system creates an empty module."""

    def exec_module(self, module: ModuleType) -> None:
        """Give the module a ``__getattr__`` that warns and returns the member of the module with the new name."""
        old, new = module.__name__, self._moved[module.__name__]

        def get_member_of_moved_module(name: str) -> Any:
            """Return the member, with a warning if it is not an attribute that the import system reads."""
            member = getattr(import_module(new), name)
            if not name.startswith("__"):
                warnings.warn(f"{old}.{name} is renamed to {new}.{name}", DeprecationWarning, stacklevel=2)
            return member

        vars(module)["__getattr__"] = get_member_of_moved_module


class OldName:
    """Old name of a member of a class: reading it gives a `DeprecationWarning` and the member with the new name.

    Args:
        new: new name of the member.
    """

    def __init__(self, new: str):
        self._new = new

    def __set_name__(self, owner: type, name: str) -> None:
        self._label = f"{owner.__name__}.{name}"

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        warnings.warn(f"{self._label} is renamed to {self._new}", DeprecationWarning, stacklevel=2)
        caller = sys._getframe(1).f_code
        for kind in (owner or type(instance)).__mro__:
            if caller is _get_code_or_none(vars(kind).get(self._new)):
                # ``super().old`` in a method of `kind` that overrides the member: the member of the next class.
                return getattr(super(kind, owner if instance is None else instance), self._new)
        return getattr(owner if instance is None else instance, self._new)


def _get_code_or_none(member: Any) -> Any:
    """Return the code of a function, class method, static method or property; None for other members."""
    function = getattr(member, "fget", None) or getattr(member, "__func__", member)
    return getattr(function, "__code__", None)


def with_old_names(**renamed: str) -> Callable[[_Class], _Class]:
    """Return a class decorator that adds old names of members; reading one gives a `DeprecationWarning`.

    Args:
        renamed: old name -> new name.

    Example:
        ``@with_old_names(within_step="stiffness_matrix_within_step")``
    """
    def add_old_names(kind: _Class) -> _Class:
        """Add an `OldName` for each renamed member; return the class."""
        for old, new in renamed.items():
            alias = OldName(new)
            # Python calls `__set_name__` only for members of the class body.
            alias.__set_name__(kind, old)
            setattr(kind, old, alias)
        return kind

    return add_old_names


def rename_old_members_of_subclass(subclass: type, renamed: Mapping[str, str]) -> None:
    """Rename the members that a subclass defines by old names to their new names, with a `DeprecationWarning`.

    To be called in ``__init_subclass__`` of a base class that plug-ins derive from. A member that the subclass defines
    by both names keeps the definition of the new name.

    Args:
        subclass: class that has just been defined.
        renamed: old name -> new name.
    """
    for old, new in renamed.items():
        annotations = vars(subclass).get("__annotations__", {})
        is_defined = old in vars(subclass) and not isinstance(vars(subclass)[old], OldName)
        if not is_defined and old not in annotations:
            continue
        if new not in vars(subclass) and new not in annotations:
            warnings.warn(f"{subclass.__name__}.{old} is renamed to {new}; define {new}", DeprecationWarning,
                          stacklevel=3)
            if is_defined:
                setattr(subclass, new, vars(subclass)[old])
        if is_defined:
            delattr(subclass, old)
        if old in annotations:
            # `dataclass` makes fields of the annotated names, in their order.
            pairs = [(new if name == old else name, kind) for name, kind in annotations.items()]
            annotations.clear()
            annotations.update(pairs)
