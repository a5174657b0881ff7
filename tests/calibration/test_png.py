"""Pictures that are laid out and drawn once look like those that matplotlib lays out and draws by itself."""

import io

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.image import imread

from calibration.report.drawing import STYLE, add_figure_legend_above_panels, create_figure_with_panel_rows
from calibration.report.png import render_png

DEPTH = np.linspace(0.0, 10.0, 60)


def shared():
    """Wide and narrow numbers, a legend above, residuals that share an axis, aligned labels."""
    figure, axes = create_figure_with_panel_rows([3, 2], 3.0)
    for number, each in enumerate(axes):
        each.plot(DEPTH, 10.0 ** (number - 2) * DEPTH**2, label=f"law {number}")
        each.set(xlabel="displacement [mm]", ylabel="model − data [N]", title=f"panel {number}")
    axes[3].sharex(axes[4])
    figure.align_labels()
    add_figure_legend_above_panels(figure)
    return figure


def logarithmic():
    figure, axes = create_figure_with_panel_rows([2], 3.0)
    axes[0].loglog(1.0 + DEPTH, np.exp(DEPTH))
    axes[1].semilogx(1.0 + DEPTH, 1e-5 * DEPTH)
    figure.suptitle("both ways")
    return figure


def coloured():
    """A frame of fixed shape with a colour bar between frames that are free."""
    figure = Figure(figsize=(12, 4), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    middle.set_aspect("equal")
    picture = middle.tripcolor([0, 1, 1, 0], [0, 0, 2, 2], [[0, 1, 2], [0, 2, 3]], [0.0, 1.0, 3.0, 2.0],
                               shading="gouraud")
    figure.colorbar(picture, ax=middle, label="stress [kPa]", shrink=0.8)
    left.plot(DEPTH, DEPTH)
    right.plot(1e4 * DEPTH, -DEPTH)
    return figure


def empty():
    """Without a layout, a spine in the middle, rotated labels, nothing drawn."""
    figure = Figure(figsize=(3, 3), layout="none")
    axes = figure.add_axes((0.2, 0.2, 0.7, 0.7))
    axes.spines["left"].set_position(("data", 0.4))
    axes.tick_params(axis="x", rotation=60)
    return figure


def pixels(png):
    return imread(io.BytesIO(png))[..., :3]


def by_matplotlib(figure, dpi):
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi)
    return stream.getvalue()


def narrow():
    """A frame that becomes far narrower."""
    figure = Figure(figsize=(4, 2), layout="constrained")
    left, right = figure.subplots(2, 2, width_ratios=(1, 6))[:, 0]
    left.plot(DEPTH, 1e-7 * DEPTH)
    left.set_ylabel("a name that is\nthree lines\nhigh")
    right.plot(DEPTH, 12345.678 + 0.01 * DEPTH)
    return figure


def frames(figure):
    """Return the frames of the axes, in fractions of the figure."""
    return np.array([axes.get_position().extents for axes in figure.axes])


@pytest.mark.slow
@pytest.mark.parametrize("dpi", [60, 150])
@pytest.mark.parametrize(("draw", "same"), [(shared, True), (logarithmic, True), (coloured, False), (empty, True),
                                            (narrow, True)])
def test_as_matplotlib_draws_it(draw, same, dpi):
    with rc_context(STYLE):
        figure, other = draw(), draw()
        ours, theirs = pixels(render_png(figure, dpi)), pixels(by_matplotlib(other, dpi))
    assert figure.dpi == other.dpi and not any("get_tightbbox" in vars(axes) for axes in figure.axes)
    assert ours.shape == theirs.shape
    np.testing.assert_allclose(frames(figure), frames(other), atol=1e-5 if same else 4e-3)
    if same:
        assert (abs(ours - theirs).max(axis=2) > 0.1).mean() < 0.001


def test_a_figure_that_was_drawn_can_be_changed_and_drawn_again():
    with rc_context(STYLE):
        figure, other = shared(), shared()
        render_png(figure, 60)
        for each in (figure, other):
            each.axes[0].set_ylim(0.0, 12345.0)
            each.axes[1].set_ylabel("another\nname")
        ours, theirs = pixels(render_png(figure, 60)), pixels(by_matplotlib(other, 60))
    assert (abs(ours - theirs).max(axis=2) > 0.1).mean() < 0.01


@pytest.mark.slow
def test_steps_of_a_drawing_are_not_repeated(monkeypatch):
    from matplotlib.text import Text

    counts = {}
    measure = Text.get_window_extent

    def counted(self, *arguments, **options):
        counts["measured"] = counts.get("measured", 0) + 1
        return measure(self, *arguments, **options)

    monkeypatch.setattr(Text, "get_window_extent", counted)
    with rc_context(STYLE):
        render_png(shared(), 60)
        ours = counts.pop("measured")
        by_matplotlib(shared(), 60)
    assert 2 * ours < counts["measured"], f"{ours} texts measured, matplotlib alone {counts['measured']}"
