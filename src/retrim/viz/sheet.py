"""Create blank figures without the global state of pyplot.

matplotlib is imported only when the first figure is drawn, so commands start faster.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import matplotlib.figure


@contextmanager
def sheet(size: tuple[float, float], font_size: float, *, boxed: bool = False) -> Iterator["matplotlib.figure.Figure"]:
    """Yield a white figure; its style applies inside the context.

    Args:
        size: Width and height [inch].
        font_size: Font size [pt].
        boxed: Whether axes have lines on all four sides; otherwise only below and on the left.
    """
    import matplotlib

    from .notebook import NotebookFigure

    with matplotlib.rc_context(
        {
            "font.size": font_size,
            "axes.spines.top": boxed,
            "axes.spines.right": boxed,
            "svg.fonttype": "none",
            "text.parse_math": False,  # dollar signs in names are plain text
            "text.usetex": False,
        }
    ):
        yield NotebookFigure(figsize=size, layout="constrained", facecolor="white")
