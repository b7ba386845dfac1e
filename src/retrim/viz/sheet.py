"""A blank figure. It is no global state of pyplot, and matplotlib is imported when the first one is drawn: a command
begins the sooner."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import matplotlib.figure


@contextmanager
def sheet(size: tuple[float, float], font_size: float, *, boxed: bool = False) -> Iterator["matplotlib.figure.Figure"]:
    """Give a white figure, whose style holds while it is drawn.

    Args:
        size: Width and height [inch].
        font_size: [pt]
        boxed: Axes have a line on all four sides; else below and on the left.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(
        {
            "font.size": font_size,
            "axes.spines.top": boxed,
            "axes.spines.right": boxed,
            "svg.fonttype": "none",
            "text.parse_math": False,  # a name with dollar signs is a name
            "text.usetex": False,
        }
    ):
        yield Figure(figsize=size, layout="constrained", facecolor="white")
