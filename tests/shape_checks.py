"""Generate the check of a nested function once, instead of at each execution of its definition.

The import hook checks the shapes and types of every function. For a nested function, it generates and compiles the
check at every call of the outer function, which takes more than a millisecond. The check depends on the code and the
annotations, so this module stores one check for each pair. It does not change the checks of arguments and results.
"""

import functools
import threading
import types
import typing

import jaxtyping
from jaxtyping import AbstractArray

_GENERATED = ("_destring_annotation", "_make_fn_with_signature", "_apply_typechecker")


def keep_checks():
    """Store the checks that jaxtyping generates for nested functions, if its private names are still the same."""
    module = getattr(jaxtyping, "_decorator", None)
    if not all(hasattr(module, name) for name in _GENERATED):
        return
    plain, checks, active = jaxtyping.jaxtyped, {}, threading.local()

    def replay(make):
        @functools.wraps(make)
        def wrapped(*args, **kwargs):
            results = getattr(active, "results", None)
            if results is None:
                return make(*args, **kwargs)
            results.append(make(*args, **kwargs) if active.earlier is None else active.earlier[len(results)])
            return results[-1]

        return wrapped

    for name in _GENERATED:
        setattr(module, name, replay(getattr(module, name)))

    @functools.wraps(plain)
    def jaxtyped(fn=None, *, typechecker):
        if fn is None:
            return functools.partial(jaxtyped, typechecker=typechecker)
        if not (isinstance(fn, types.FunctionType) and "<locals>" in fn.__qualname__):
            return plain(fn, typechecker=typechecker)
        try:
            key = fn.__code__, typechecker, tuple((name, _identity(a)) for name, a in fn.__annotations__.items())
            earlier = checks.get(key)
        except TypeError:  # an annotation without a hash
            return plain(fn, typechecker=typechecker)
        active.earlier, active.results = earlier, []
        try:
            result = plain(fn, typechecker=typechecker)
            checks.setdefault(key, active.results)
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
