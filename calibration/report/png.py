"""A figure as a PNG, laid out and drawn once.

``savefig`` draws a figure twice where it has a layout, the first time for the layout alone, and a constrained layout
measures all panels twice; in each pass matplotlib asks an axis some ten times where its ticks are, and measures their
labels anew. Here an axis answers from memory as long as nothing has moved, and a panel whose tick labels stay the same
is as much larger than its frame as before. The picture is the same up to a pixel or two of the layout, for two thirds
of the time.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

#: What an axis is asked again and again. Where matplotlib has other names for it pictures are the same, and slower.
_ASKED_AGAIN = ("_update_ticks", "_get_ticklabel_bboxes")
#: Decimals of a pixel to which a panel is where it was.
_STILL = 6
#: A frame that has become this share of itself larger or smaller has the same around it: the last number at an axis
#: stands out by more or less, but that is a pixel or two.
_AS_LARGE = 0.25
#: Of zlib: files are up to a tenth larger than with its default, about as large as with transparency, in half the time.
_COMPRESSION = 3


def as_png(figure: Any, dpi: float = 150) -> bytes:
    """The figure as a PNG, without transparency.

    Args:
        figure: of matplotlib; its layout, if any, is computed anew. dpi: pixels an inch.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    own = figure.get_dpi()
    figure.set_dpi(dpi)
    try:
        canvas = FigureCanvasAgg(figure)
        with _measured_once(figure):
            canvas.draw()
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    finally:
        figure.set_dpi(own)
    stream = io.BytesIO()
    picture.save(stream, "png", dpi=(dpi, dpi), compress_level=_COMPRESSION)
    return stream.getvalue()


@contextmanager
def _measured_once(figure: Any) -> Iterator[None]:
    """While a figure is drawn and nobody else changes it: what has been measured is not measured again."""
    taught: list[tuple[Any, str]] = []
    for axes in figure.axes:
        answers = {(axis, name): _from_memory(axes, getattr(axis, name)) for axis in (axes.xaxis, axes.yaxis)
                   for name in _ASKED_AGAIN if hasattr(axis, name)}
        answers[axes, "get_tightbbox"] = _as_around_its_frame(axes)
        for (artist, name), answer in answers.items():
            vars(artist)[name] = answer
            taught.append((artist, name))
    try:
        yield
    finally:
        for artist, name in taught:
            del vars(artist)[name]


def _from_memory(axes: Any, measure: Callable[..., Any]) -> Callable[..., Any]:
    """A method of an axis of these axes that looks anew only where the frame or its limits have changed."""
    known: dict[tuple, Any] = {}
    there: list[Any] = []

    def answer(*asked: Any, **options: Any) -> Any:
        if options:
            return measure(*asked, **options)
        place = [*axes.bbox.extents.round(_STILL).tolist(), *axes.viewLim.extents.tolist()]
        if place != there:
            # Ticks are changed in place: what was known of another frame is no longer so.
            known.clear()
            there[:] = place
        what = tuple(tuple(map(id, one)) if isinstance(one, list) else id(one) for one in asked)
        if what not in known:
            # With what was asked, so that nothing else gets its number.
            known[what] = measure(*asked), asked
        return known[what][0]

    return answer


def _as_around_its_frame(axes: Any) -> Callable[..., Any]:
    """How large axes are with all that is around them: a layout that moves them leaves that as it is, unless it makes
    their frame much larger or smaller, or their tick labels change."""
    from matplotlib.transforms import Bbox

    measure = axes.get_tightbbox
    known: list[tuple[list[list[str]], Any, Any]] = []

    def answer(renderer: Any = None, **options: Any) -> Any:
        # A frame of fixed shape, or one that follows others, is not where the layout puts it.
        if not options.get("for_layout_only") or axes.get_aspect() != "auto" or axes.get_axes_locator():
            return measure(renderer, **options)
        labels = [[label.get_text() for label in axis.get_ticklabels()] for axis in (axes.xaxis, axes.yaxis)]
        for those, size, around in known:
            if those == labels and (abs(axes.bbox.size / size - 1.0) < _AS_LARGE).all():
                return Bbox.from_extents(axes.bbox.extents + around)
        whole = measure(renderer, **options)
        if whole is not None and (axes.bbox.size > 0.0).all():
            known.append((labels, axes.bbox.size, whole.extents - axes.bbox.extents))
        return whole

    return answer
