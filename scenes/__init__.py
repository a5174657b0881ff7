"""scenes: what people meet. Ready-made scenes, the command line and the demo.

Public names are listed here once and imported on first use, so that ``tissue-sim --help`` is instant.
"""

from importlib import import_module as _import_module

_HOMES = {
    "SCENES": "compression", "Scene": "compression",
    "draw_simulation": "figures",
    "run_demo": "demo",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(_import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__():
    return sorted([*globals(), *_HOMES])
