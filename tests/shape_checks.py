"""Make the check of a nested function once, instead of each time that its definition runs.

The import hook checks the shapes and types of every function. For a function inside a function, it generates and
compiles the check again at every call of the outer one, which takes more than a millisecond. The check depends on the
code and the annotations, so it is kept for each pair of them. All arguments and results are checked as before.
"""

import functools
import threading
import types
import typing

import jaxtyping
from jaxtyping import AbstractArray

_GENERATED = ("_destring_annotation", "_make_fn_with_signature", "_apply_typechecker")


def keep_checks():
    """Keep the checks that jaxtyping generates for nested functions; keep none if its private names have changed."""
    module = getattr(jaxtyping, "_decorator", None)
    if not all(hasattr(module, name) for name in _GENERATED):
        return
    plain, kept, active = jaxtyping.jaxtyped, {}, threading.local()

    def replayed(make):
        @functools.wraps(make)
        def wrapped(*args, **kwargs):
            results = getattr(active, "results", None)
            if results is None:
                return make(*args, **kwargs)
            results.append(make(*args, **kwargs) if active.earlier is None else active.earlier[len(results)])
            return results[-1]

        return wrapped

    for name in _GENERATED:
        setattr(module, name, replayed(getattr(module, name)))

    @functools.wraps(plain)
    def jaxtyped(fn=None, *, typechecker):
        if fn is None:
            return functools.partial(jaxtyped, typechecker=typechecker)
        if not (isinstance(fn, types.FunctionType) and "<locals>" in fn.__qualname__):
            return plain(fn, typechecker=typechecker)
        try:
            key = fn.__code__, typechecker, tuple((name, _identity(a)) for name, a in fn.__annotations__.items())
            earlier = kept.get(key)
        except TypeError:  # an annotation without a hash
            return plain(fn, typechecker=typechecker)
        active.earlier, active.results = earlier, []
        try:
            result = plain(fn, typechecker=typechecker)
            kept.setdefault(key, active.results)
        finally:
            active.results = None
        return result

    jaxtyping.jaxtyped = jaxtyped


def _identity(annotation):
    """Return a value that is equal for annotations with the same check."""
    if isinstance(annotation, type) and issubclass(annotation, AbstractArray):
        return _identity(annotation.array_type), annotation.dtypes, annotation.dim_str
    arguments = typing.get_args(annotation)
    if not arguments:
        return annotation
    return typing.get_origin(annotation), tuple(_identity(each) for each in arguments)
