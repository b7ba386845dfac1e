"""Numbers and arrays as C literals, exact in single precision."""

import numpy as np

WIDTH = 8  # numbers per line


def number(value: float) -> str:
    """Return the C literal of a number."""
    text = f"{np.float32(value):.9g}"
    return f"{text}f" if any(sign in text for sign in ".e") else f"{text}.0f"


def bits(value: float) -> str:
    """Return the bits of a number in single precision, as a C literal."""
    return f"0x{np.float32(value).view(np.uint32):08x}u"


def array(name: str, values: np.ndarray) -> list[str]:
    """Return the lines that define a constant array of numbers, row by row."""
    flat = [number(x) for x in values.ravel().tolist()]
    rows = [", ".join(flat[i : i + WIDTH]) for i in range(0, len(flat), WIDTH)]
    return [f"static const float {name}[{len(flat)}] = {{", ",\n".join(rows), "};"]
