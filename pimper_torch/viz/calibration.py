"""Expected against true error as a figure."""

from collections.abc import Sequence
from pathlib import Path

TITLE = "pimper_torch calibration"
"""Of the PNG, by which a former one is known."""


def draw_calibration(
    expected: Sequence[float],
    root_mean_square: Sequence[float],
    robust: Sequence[float],
    unit: str,
    path: Path | str,
) -> None:
    """Draw the calibration curve on logarithmic axes, and the diagonal that is right.

    Args:
        robust: The same, blind to outliers.
    """
    # Local, so that importing the package does not load matplotlib; Figure without pyplot
    # leaves no global state behind.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.5, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    ends = [f([*expected, *robust, *root_mean_square]) for f in (min, max)]
    axes.plot(ends, ends, color="0.7", label="calibrated")
    axes.plot(expected, root_mean_square, "o-", label="root mean square")
    axes.plot(expected, robust, "s--", label="median / 0.6745")
    axes.set(
        xscale="log", yscale="log", xlabel=f"expected error, {unit}", ylabel=f"true error, {unit}"
    )
    axes.set_aspect("equal")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150, format="png", metadata={"Title": TITLE})
