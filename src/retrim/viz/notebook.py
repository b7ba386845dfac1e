"""Figures that a notebook shows without pyplot and its global state."""

import io

from matplotlib.figure import Figure


class NotebookFigure(Figure):
    """A figure that a notebook shows as a PNG image."""

    def _repr_png_(self) -> bytes:
        """Return the image for a notebook."""
        with io.BytesIO() as image:
            self.savefig(image, format="png", dpi=90)
            return image.getvalue()
