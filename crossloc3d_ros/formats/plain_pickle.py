"""Pickles of plain containers, numbers and texts, read without ever calling what a pickle names.

Python's own unpickler calls whatever a pickle asks for. This one takes the pickle's instructions as data (`pickletools`
parses them) and knows what the plain ones mean; everything else is refused by its name. Of numpy it knows the few names
that numbers and arrays of numbers are pickled under, and makes these numbers itself.

Lists of whole numbers come as arrays: the published training pickles hold some 400 million of them, which as Python
objects would take 14 GB.
"""

from __future__ import annotations

import mmap
import pickletools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from crossloc3d_ros.errors import DatasetError
from crossloc3d_ros.types import Int32Array, UInt8Array

MOST_BYTES = 8 << 30  # far more than any dataset's file: what is larger is refused before it is read
_RUN = 4096  # numbers decoded at once

_NUMBER = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248]|U\d{1,4}|S\d{1,4})")

_NAMES = {
    ("numpy", "dtype"): "dtype",
    ("numpy", "ndarray"): "ndarray",
    ("numpy.core.multiarray", "scalar"): "scalar",
    ("numpy._core.multiarray", "scalar"): "scalar",
    ("numpy.core.multiarray", "_reconstruct"): "array",
    ("numpy._core.multiarray", "_reconstruct"): "array",
    ("numpy.core.numeric", "_frombuffer"): "buffer",
    ("numpy._core.numeric", "_frombuffer"): "buffer",
    ("_codecs", "encode"): "encode",  # how protocols 0 to 2 write bytes
    ("builtins", "bytes"): "bytes",  # and no bytes at all
    ("__builtin__", "bytes"): "bytes",
    ("builtins", "set"): "set",
    ("__builtin__", "set"): "set",
    ("builtins", "frozenset"): "frozenset",
    ("__builtin__", "frozenset"): "frozenset",
}
"""The names that a plain pickle may hold, under numpy 1 and 2 and Python 2 and 3, and what they mean here."""

_VALUES = {
    "INT", "LONG", "BININT", "BININT1", "BININT2", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "STRING", "BINSTRING",
    "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8", "UNICODE", "SHORT_BINUNICODE",
    "BINUNICODE", "BINUNICODE8",
}  # fmt: skip
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_EMPTY: dict[str, Callable[[], Any]] = {"EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_SET": set, "EMPTY_TUPLE": tuple}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}

_TAKE_FEW = {"TUPLE1", "TUPLE2", "TUPLE3", "APPEND", "SETITEM", "REDUCE", "BUILD", "POP"}
"""Instructions that take single values off the stack; the others take all since a mark."""

Shrink = Callable[[Any, Any], Any]
"""Takes a key and its value as a dictionary receives them, and returns what to keep of the value."""


def read_plain_pickle(path: Path, shrink: Shrink | None = None, *, most_bytes: int = MOST_BYTES) -> Any:
    """Return what a pickle holds: dict, list, tuple, set, str, bytes, numbers, None and arrays of numbers.

    A list of whole numbers alone comes as an int32 or int64 array if they fit; an empty one stays a list. `shrink` may
    replace values before the next one is read. Raises DatasetError for a missing, damaged, cut or oversized file, and
    for one that names anything but plain things, naming that.
    """
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            if size > most_bytes:
                raise DatasetError(f"{path} is refused: it has {size:,} bytes, more than {most_bytes:,}")
            if size == 0:
                raise DatasetError(f"{path} is empty; copy it again from where it came")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
                return _Machine(path, shrink).run(mapped)
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing") from error
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, IndexError, KeyError, TypeError, AttributeError, OverflowError, MemoryError) as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise DatasetError(f"{path} is damaged or cut short ({reason}); copy it again from where it came") from error


_INT64 = np.iinfo(np.int64)


class _Mark:
    """Where a group of values on the stack begins."""


class _Name:
    """One of the names that are admitted; nothing that can be called."""

    def __init__(self, meaning: str) -> None:
        self.meaning = meaning


class _Run:
    """Some whole numbers in a row."""

    def __init__(self, values: npt.NDArray[np.integer[Any]]) -> None:
        self.values = values


class _Kept:
    """The only item of a list that was replaced by something smaller."""

    def __init__(self, value: Any) -> None:
        self.value = value


class _Kind:
    """A numpy type of numbers or texts of fixed length."""

    def __init__(self, code: Any) -> None:
        if not isinstance(code, str) or not _NUMBER.fullmatch(code):
            raise ValueError(f"an array of {code!r} is not one of plain numbers")
        self.dtype: np.dtype[Any] = np.dtype(code)

    def set_state(self, state: Any) -> None:
        """Take over the byte order; the rest of a type's state describes what plain numbers do not have."""
        if not isinstance(state, tuple) or len(state) < 5 or any(part is not None for part in state[2:5]):
            raise ValueError("an array with fields is not one of plain numbers")
        order = state[1].decode("ascii") if isinstance(state[1], bytes) else state[1]
        if order not in ("<", ">", "|", "="):
            raise ValueError(f"unknown byte order {order!r}")
        if order == "<":
            self.dtype = self.dtype.newbyteorder("<")
        elif order == ">":
            self.dtype = self.dtype.newbyteorder(">")

    def read(self, raw: Any, shape: Any, order: str) -> npt.NDArray[Any]:
        """Return the array of raw bytes."""
        data = raw.encode("latin-1") if isinstance(raw, str) else bytes(raw)
        values = np.frombuffer(data, self.dtype)
        return values.reshape(tuple(int(n) for n in shape), order="F" if order == "F" else "C").copy()


class _Array:
    """An array whose content comes a moment later."""

    def __init__(self) -> None:
        self.value: npt.NDArray[Any] | None = None

    def set_state(self, state: Any) -> None:
        """Take over shape, type and bytes."""
        _, shape, kind, fortran, raw = state
        if not isinstance(kind, _Kind):
            raise ValueError("an array without a type")
        self.value = kind.read(raw, shape, "F" if fortran else "C")


_PARTS = (_Kind, _Name, _Mark)


class _Machine:
    """The stack and the memo of one pickle."""

    def __init__(self, path: Path, shrink: Shrink | None) -> None:
        self._path = path
        self._shrink = shrink
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self, mapped: mmap.mmap) -> Any:
        data: UInt8Array = np.frombuffer(mapped, np.uint8)
        try:
            for opcode, argument, _ in pickletools.genops(mapped):  # type: ignore[arg-type]  # reads as a file
                if opcode.name == "STOP":
                    return _settled(self._stack.pop())
                self._step(opcode.name, argument)
                if opcode.name in ("MARK", "FRAME"):
                    for run in _runs(data, mapped):
                        self._stack.append(run)
        finally:
            del data  # or the file could not be closed
        raise ValueError("it has no end")

    def _step(self, name: str, argument: Any) -> None:
        if name in _TAKE_FEW and any(isinstance(item, _Run) for item in self._stack[-3:]):
            self._stack[-3:] = _expanded(self._stack[-3:])
        is_known = self._push(name, argument) or self._take_few(name) or self._take_group(name)
        if not (is_known or self._take_names(name, argument) or name in ("PROTO", "FRAME")):
            raise self._refused(f"the instruction {name}")

    def _push(self, name: str, argument: Any) -> bool:
        """Carry out an instruction that puts a value on the stack or into the memo; return whether it is one."""
        stack = self._stack
        if name in _VALUES:
            stack.append(argument)
        elif name in ("BINGET", "LONG_BINGET", "GET"):
            stack.append(self._memo[int(argument)])
        elif name == "MEMOIZE":
            self._memo[len(self._memo)] = stack[-1]
        elif name in ("BINPUT", "LONG_BINPUT", "PUT"):
            self._memo[int(argument)] = stack[-1]
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name in _EMPTY:
            stack.append(_EMPTY[name]())
        elif name == "MARK":
            stack.append(_Mark())
        else:
            return False
        return True

    def _take_few(self, name: str) -> bool:
        """Carry out an instruction that takes one to three values off the stack; return whether it is one."""
        stack = self._stack
        if name in _TUPLES:
            items = stack[-_TUPLES[name] :]
            if len(items) < _TUPLES[name]:
                raise ValueError("the stack is empty")
            stack[-_TUPLES[name] :] = [_tuple(items)]
        elif name == "APPEND":
            value = stack.pop()
            self._extend(stack[-1], [value])
        elif name == "SETITEM":
            value, key = stack.pop(), stack.pop()
            self._set(stack[-1], [key, value])
        elif name == "POP":
            stack.pop()
        else:
            return False
        return True

    def _take_group(self, name: str) -> bool:
        """Carry out an instruction that takes all since the last mark; return whether it is one."""
        stack = self._stack
        if name == "APPENDS":
            items = self._group(expand=False)
            self._extend(stack[-1], items)
        elif name == "SETITEMS":
            items = self._group()
            self._set(stack[-1], items)
        elif name == "DICT":
            items = self._group()
            stack.append({})
            self._set(stack[-1], items)
        elif name == "LIST":
            stack.append(self._group(expand=False))
        elif name == "TUPLE":
            stack.append(_tuple(self._group()))
        elif name == "ADDITEMS":
            items = self._group()
            stack[-1].update(items)
        elif name == "FROZENSET":
            stack.append(frozenset(self._group()))
        elif name == "POP_MARK":
            self._group()
        else:
            return False
        return True

    def _take_names(self, name: str, argument: Any) -> bool:
        """Carry out an instruction on what a pickle names, calling nothing; return whether it is one."""
        stack = self._stack
        if name == "GLOBAL":
            module, _, attribute = argument.partition(" ")
            stack.append(self._name(module, attribute))
        elif name == "STACK_GLOBAL":
            attribute, module = stack.pop(), stack.pop()
            stack.append(self._name(module, attribute))
        elif name == "REDUCE":
            arguments, function = stack.pop(), stack.pop()
            stack.append(self._made(function, arguments))
        elif name == "BUILD":
            state = stack.pop()
            if not isinstance(stack[-1], (_Kind, _Array)):
                raise self._refused(f"the state of a {type(stack[-1]).__name__}")
            stack[-1].set_state(state)
        else:
            return False
        return True

    def _group(self, *, expand: bool = True) -> list[Any]:
        """Take what lies on the stack above the last mark."""
        stack = self._stack
        for at in range(len(stack) - 1, -1, -1):
            if isinstance(stack[at], _Mark):
                items = stack[at + 1 :]
                del stack[at:]
                return list(_expanded(items)) if expand else items
        raise ValueError("a group has no beginning")

    def _extend(self, target: Any, items: list[Any]) -> None:
        if not isinstance(target, list):
            raise ValueError("items for something that is no list")
        target.extend(item if isinstance(item, _Run) else _settled(item) for item in items)

    def _set(self, target: Any, items: list[Any]) -> None:
        if not isinstance(target, dict) or len(items) % 2:
            raise ValueError("keys and values for something that is no dictionary")
        for key, value in zip(items[::2], items[1::2], strict=True):
            kept = _settled(value)
            if self._shrink is not None:
                kept = self._shrink(key, kept)
                if isinstance(value, list) and kept is not value:  # the memo goes on holding it
                    value[:] = [_Kept(kept)]
            target[key] = kept

    def _name(self, module: Any, attribute: Any) -> _Name:
        if (module, attribute) not in _NAMES:
            raise self._refused(f"{module}.{attribute}")
        return _Name(_NAMES[module, attribute])

    def _made(self, function: Any, arguments: Any) -> Any:
        """Return what a plain call would give, made here."""
        if not isinstance(function, _Name) or not isinstance(arguments, tuple):
            raise self._refused(f"a call of a {type(function).__name__}")
        meaning = function.meaning
        if meaning == "dtype":
            return _Kind(arguments[0])
        if meaning == "array":
            if not isinstance(arguments[0], _Name) or arguments[0].meaning != "ndarray":
                raise self._refused("an array of another class")
            return _Array()
        if meaning == "scalar" and isinstance(arguments[0], _Kind):
            return arguments[0].read(arguments[1], (1,), "C")[0].item()
        if meaning == "buffer" and isinstance(arguments[1], _Kind):
            raw, kind, shape, order = arguments
            return kind.read(raw, shape, order)
        if meaning == "encode" and arguments[1:] in (("latin1",), ("latin-1",)):
            return arguments[0].encode("latin-1")
        if meaning == "bytes" and arguments == ():
            return b""
        if meaning in ("set", "frozenset") and len(arguments) <= 1:
            content = arguments[0] if arguments else ()
            items = content.tolist() if isinstance(content, np.ndarray) else list(content)
            return set(items) if meaning == "set" else frozenset(items)
        raise self._refused(f"a call of '{meaning}' with unusual arguments")

    def _refused(self, what: str) -> DatasetError:
        return DatasetError(
            f"{self._path} is refused: it asks for {what}, and a dataset's pickle holds plain containers, numbers and "
            "texts alone; do not open it with anything else unless you trust who made it"
        )


def _expanded(items: Any) -> Iterator[Any]:
    for item in items:
        if isinstance(item, _Run):
            yield from item.values.tolist()
        else:
            yield item


def _tuple(items: list[Any]) -> tuple[Any, ...]:
    """Return a tuple, which may be the arguments of a call and then holds types."""
    return tuple(item if isinstance(item, _PARTS) else _settled(item) for item in items)


def _settled(value: Any) -> Any:
    """Return a finished value: a list of whole numbers as an array, an array that was a placeholder as itself."""
    if isinstance(value, _Array):
        if value.value is None:
            raise ValueError("an array without content")
        return value.value
    if isinstance(value, _PARTS) or (isinstance(value, tuple) and any(isinstance(item, _PARTS) for item in value)):
        raise ValueError("a type or a function where a value should be")
    if isinstance(value, _Run):
        return int(value.values[0])
    if isinstance(value, list) and value:
        if isinstance(value[0], _Kept):
            return value[0].value
        if all(isinstance(item, _Run) for item in value):
            return np.concatenate([item.values for item in value])
        if any(isinstance(item, _Run) for item in value):
            value[:] = _expanded(value)
        if all(type(item) is int and _INT64.min <= item <= _INT64.max for item in value):
            return np.array(value, np.int64)
    return value


def _runs(data: UInt8Array, mapped: mmap.mmap) -> Iterator[_Run]:
    """Yield the whole numbers that follow, read at once instead of one by one."""
    while True:
        values, at = _decode(data, mapped.tell(), _RUN)
        if len(values) == 0:
            return
        mapped.seek(at)
        yield _Run(values)


@njit(cache=True, nogil=True)
def _decode(data: UInt8Array, at: int, most: int) -> tuple[Int32Array, int]:
    """Return the numbers (at most `most`) of the opcodes BININT1, BININT2 and BININT at `at`, and where they end."""
    values = np.empty(most, np.int32)
    count = 0
    while count < most and at < len(data):
        code = data[at]
        if code == 0x4B and at + 2 <= len(data):
            values[count] = data[at + 1]
            at += 2
        elif code == 0x4D and at + 3 <= len(data):
            values[count] = np.int32(data[at + 1]) | (np.int32(data[at + 2]) << 8)
            at += 3
        elif code == 0x4A and at + 5 <= len(data):
            number = np.uint32(data[at + 1]) | (np.uint32(data[at + 2]) << np.uint32(8))
            number = number | (np.uint32(data[at + 3]) << np.uint32(16)) | (np.uint32(data[at + 4]) << np.uint32(24))
            values[count] = np.int32(number)
            at += 5
        else:
            break
        count += 1
    return values[:count].copy(), at
