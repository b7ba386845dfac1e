"""Measures JAX compile time separately from run time."""

import threading
import time

import jax

EVENTS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)


class Stopwatch:
    """Measures compile time (tracing, lowering, XLA and cache reads) and run time since its creation."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._compiling = list[tuple[float, float]]()  # intervals in order, without overlap
        self._lock = threading.Lock()
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event in EVENTS:
            now = time.perf_counter()
            self.compiled(max(self._began, now - duration_secs), now)

    def compiled(self, start: float, end: float) -> None:
        """Add an interval of compilation; overlapping intervals count once."""
        with self._lock:
            while self._compiling and self._compiling[-1][1] >= start:
                before = self._compiling.pop()
                start, end = min(start, before[0]), max(end, before[1])
            self._compiling.append((start, end))

    @property
    def compile_s(self) -> float:
        """Compile time so far [s]."""
        with self._lock:
            return sum((end - start for start, end in self._compiling), start=0.0)

    @property
    def total_s(self) -> float:
        """Time since the start [s]."""
        return time.perf_counter() - self._began

    def sentence(self) -> str:
        """Return the compile time and the run time in words."""
        compiling = self.compile_s
        return f"Compiling {compiling:.0f} s, all else {self.total_s - compiling:.0f} s."
