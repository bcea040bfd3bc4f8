"""Typed contents of files from the few keys that a test is about."""

from typing import Any, Literal, get_args, get_origin

from msgspec import Struct, structs

from rrr_oc.schema import built


def filled(given: Any, kind: type) -> Any:
    """Plain data as a structure; required keys that are not given are as empty as their types allow."""
    return given if isinstance(given, kind) else built(_whole(given, kind), kind)


def _whole(given: Any, kind: Any) -> Any:
    members = [m for m in get_args(kind) if m is not type(None)] if get_origin(kind) not in (dict, list, tuple, Literal) else []
    if members and isinstance(given, dict | list):  # of a union the structures and lists of structures
        fitting = [m for m in members if (isinstance(m, type) and issubclass(m, Struct)) == isinstance(given, dict)]
        return _whole(given, fitting[0]) if fitting else given
    if isinstance(kind, type) and issubclass(kind, Struct) and isinstance(given, dict):
        fields = {f.encode_name: f for f in structs.fields(kind)}
        return given | {
            name: _whole(given[name], f.type) if name in given else _empty(f.type)
            for name, f in fields.items()
            if name in given or f.required
        }
    if get_origin(kind) is dict and isinstance(given, dict):
        return {key: _whole(value, get_args(kind)[1]) for key, value in given.items()}
    if get_origin(kind) in (list, tuple) and isinstance(given, list | tuple):
        return [_whole(value, get_args(kind)[0]) for value in given]
    return given


def _empty(kind: Any) -> Any:
    """A value of a type that says nothing."""
    if get_origin(kind) is Literal:
        return get_args(kind)[0]
    if get_origin(kind) in (dict, list, tuple):
        arguments = get_args(kind)
        return {} if get_origin(kind) is dict else [_empty(a) for a in arguments if arguments[1:] != (...,)]
    if isinstance(kind, type) and issubclass(kind, Struct):
        return _whole({}, kind)
    if get_args(kind):
        return None if type(None) in get_args(kind) else _empty(get_args(kind)[0])
    return {str: "", float: 0.0, int: 0, bool: False}.get(kind)
