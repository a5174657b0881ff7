"""Render a matplotlib figure as PNG with cached layout measurements.

``savefig`` draws a figure with a layout twice, first for the layout only, and a constrained layout measures all panels
twice. In each pass matplotlib computes ticks and label sizes of an axis about ten times. This module caches the results
while the position and the limits of the axes are unchanged. It also reuses the margin of a panel around its frame
while the tick labels are unchanged. The image is the same up to one or two pixels of the layout, in two thirds of the
time.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

#: Methods of an axis whose results are cached. If matplotlib renames them, images are the same and rendering is slower.
_CACHED_METHODS = ("_update_ticks", "_get_ticklabel_bboxes")
#: Decimals of a pixel to which the position of a panel is compared.
_POSITION_DECIMALS = 6
#: Relative change of the frame size up to which the cached margin is used; the error is one or two pixels.
_MAX_SIZE_CHANGE = 0.25
#: zlib level: up to 10 % larger files than with the default level, in half the time.
_COMPRESSION = 3


def render_png(figure: Any, dpi: float = 150) -> bytes:
    """Return a matplotlib figure as a PNG image without transparency.

    Args:
        figure: matplotlib figure; its layout, if any, is recomputed.
        dpi: resolution, pixels per inch.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    own = figure.get_dpi()
    figure.set_dpi(dpi)
    try:
        canvas = FigureCanvasAgg(figure)
        with _cache_axis_measurements(figure):
            canvas.draw()
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    finally:
        figure.set_dpi(own)
    stream = io.BytesIO()
    picture.save(stream, "png", dpi=(dpi, dpi), compress_level=_COMPRESSION)
    return stream.getvalue()


@contextmanager
def _cache_axis_measurements(figure: Any) -> Iterator[None]:
    """Replace the measuring methods of all axes by cached versions while the figure is drawn.

    The figure must not be changed by other code in the meantime.
    """
    replaced: list[tuple[Any, str]] = []
    for axes in figure.axes:
        methods = {(axis, name): _cache_by_frame_and_limits(axes, getattr(axis, name))
                   for axis in (axes.xaxis, axes.yaxis)
                   for name in _CACHED_METHODS if hasattr(axis, name)}
        methods[axes, "get_tightbbox"] = _make_margin_caching_get_tightbbox(axes)
        for (artist, name), method in methods.items():
            vars(artist)[name] = method
            replaced.append((artist, name))
    try:
        yield
    finally:
        for artist, name in replaced:
            del vars(artist)[name]


def _cache_by_frame_and_limits(axes: Any, measure: Callable[..., Any]) -> Callable[..., Any]:
    """Return a cached version of an axis method, which is called again only if the frame or the limits have changed."""
    cache: dict[tuple, Any] = {}
    last_position: list[Any] = []

    def measure_or_reuse(*arguments: Any, **options: Any) -> Any:
        """Return the cached measurement, or measure if the frame or the limits have changed or options are given."""
        if options:
            return measure(*arguments, **options)
        position = [*axes.bbox.extents.round(_POSITION_DECIMALS).tolist(), *axes.viewLim.extents.tolist()]
        if position != last_position:
            # matplotlib changes ticks in place: results of another frame are invalid.
            cache.clear()
            last_position[:] = position
        key = tuple(tuple(map(id, one)) if isinstance(one, list) else id(one) for one in arguments)
        if key not in cache:
            # The arguments are kept alive so that no other object can have the same id.
            cache[key] = measure(*arguments), arguments
        return cache[key][0]

    return measure_or_reuse


def _make_margin_caching_get_tightbbox(axes: Any) -> Callable[..., Any]:
    """Return a function in place of `get_tightbbox` that reuses the margin between the frame and the outer box.

    The margin is measured again if the tick labels change or if the frame changes its size by `_MAX_SIZE_CHANGE`.
    """
    from matplotlib.transforms import Bbox

    measure = axes.get_tightbbox
    cache: list[tuple[list[list[str]], Any, Any]] = []

    def measure_or_reuse(renderer: Any = None, **options: Any) -> Any:
        """Return the frame widened by a cached margin, or measure the outer box and store the margin."""
        # A frame with fixed aspect or with a locator is not placed by the layout.
        if not options.get("for_layout_only") or axes.get_aspect() != "auto" or axes.get_axes_locator():
            return measure(renderer, **options)
        labels = [[label.get_text() for label in axis.get_ticklabels()] for axis in (axes.xaxis, axes.yaxis)]
        for cached_labels, size, margin in cache:
            if cached_labels == labels and (abs(axes.bbox.size / size - 1.0) < _MAX_SIZE_CHANGE).all():
                return Bbox.from_extents(axes.bbox.extents + margin)
        outer = measure(renderer, **options)
        if outer is not None and (axes.bbox.size > 0.0).all():
            cache.append((labels, axes.bbox.size, outer.extents - axes.bbox.extents))
        return outer

    return measure_or_reuse
