"""Rules that a field of a message must keep, and the plan that moves a dataclass to and from its message by them.

The same rules are applied on the way out and on the way in, so that nothing can be sent that its receiver would refuse.
"""

# ruff: noqa: D102 (the methods of a rule are described once, at Rule)
from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import Any, TypeVar

import numpy as np
from google.protobuf.internal.enum_type_wrapper import EnumTypeWrapper
from google.protobuf.message import Message

from vggt_motion.bus.wire import Pieces, delimited, parts_of

_CONTROL = re.compile("[\x00-\x1f\x7f\x85\u2028\u2029]")
_CONTROL_BUT_LINES = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


Part = TypeVar("Part")


class FieldError(ValueError):
    """A value that breaks a rule; collects the path to it on its way up."""

    def __init__(self, problem: str) -> None:
        super().__init__(problem)
        self.problem = problem
        self.path: list[str] = []

    def at(self, place: str) -> FieldError:
        """The same error, one level further out."""
        self.path.insert(0, place)
        return self


class Rule:
    """How one field is checked and moved; the default implementations serve scalar fields."""

    def check(self, value: Any) -> Any:
        """The value to store, or FieldError."""
        raise NotImplementedError

    def put(self, message: Message, name: str, value: Any) -> None:
        """Set the field of a message."""
        setattr(message, name, self.check(value))

    def take(self, message: Message, name: str) -> Any:
        """Read the field of a message."""
        return self.check(getattr(message, name))

    def extend(self, container: Any, values: Any) -> None:
        """Fill a repeated field."""
        container.extend([self.check(value) for value in values])

    def collect(self, container: Any) -> list[Any]:
        """Read a repeated field."""
        return [self.check(value) for value in container]

    def pieces(self, number: int, value: Any) -> list[bytes | memoryview]:
        """The field as it stands on the wire under this number, in pieces, without a copy of what is long."""
        raise NotImplementedError

    def take_lifted(self, message: Message, name: str, contents: tuple[memoryview, ...]) -> Any:
        """Read a field whose contents were taken out of the message before."""
        raise NotImplementedError


@dataclass(frozen=True)
class Text(Rule):
    """A string of bounded length, without control characters; of one line unless ``many_lines``."""

    max_chars: int = 4096
    min_chars: int = 0
    pattern: re.Pattern[str] | None = None
    meaning: str = ""  # what the pattern wants, for the error
    many_lines: bool = False

    def check(self, value: Any) -> Any:
        if not isinstance(value, str):
            raise FieldError(f"must be text, not {type(value).__name__}")
        if not self.min_chars <= len(value) <= self.max_chars:
            raise FieldError(f"has {len(value)} characters, allowed are {self.min_chars} to {self.max_chars}")
        if self.pattern is not None and self.pattern.fullmatch(value) is None:
            raise FieldError(f"must be {self.meaning}")
        if not value.isprintable():
            if (_CONTROL_BUT_LINES if self.many_lines else _CONTROL).search(value) is not None:
                raise FieldError(
                    "must not contain control characters"
                    if self.many_lines
                    else "must be one line without control characters"
                )
            if any("\ud800" <= character <= "\udfff" for character in value):
                raise FieldError("must be valid Unicode")
        return value


@dataclass(frozen=True)
class Whole(Rule):
    """An integer in a range."""

    low: int
    high: int

    def check(self, value: Any) -> Any:
        if type(value) is not int:
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
                raise FieldError(f"must be a whole number, not {type(value).__name__}")
            value = int(value)
        if not self.low <= value <= self.high:
            raise FieldError(f"is {value}, allowed are {self.low} to {self.high}")
        return value


@dataclass(frozen=True)
class Real(Rule):
    """A float in a range; NaN only where it means "cannot tell"."""

    low: float = -math.inf
    high: float = math.inf
    allow_nan: bool = False
    allow_infinite: bool = False

    def check(self, value: Any) -> Any:
        if type(value) is not float:
            if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
                raise FieldError(f"must be a number, not {type(value).__name__}")
            value = float(value)
        if not math.isfinite(value):
            if math.isnan(value):
                if self.allow_nan:
                    return math.nan  # one bit pattern, so that equal records have equal bytes
                raise FieldError("must not be NaN")
            if not self.allow_infinite:
                raise FieldError("must be finite")
        if not self.low <= value <= self.high:
            raise FieldError(f"is {value:g}, allowed are {self.low:g} to {self.high:g}")
        return value + 0.0  # minus zero and zero are the same value


@dataclass(frozen=True)
class Flag(Rule):
    """A boolean."""

    def check(self, value: Any) -> Any:
        if not isinstance(value, (bool, np.bool_)):
            raise FieldError(f"must be true or false, not {type(value).__name__}")
        return bool(value)


@dataclass(frozen=True)
class Raw(Rule):
    """Bytes of bounded length."""

    max_bytes: int
    min_bytes: int = 0

    def check(self, value: Any) -> Any:
        if not isinstance(value, (bytes, memoryview, Pieces)):
            raise FieldError(f"must be bytes, not {type(value).__name__}")
        if not self.min_bytes <= len(value) <= self.max_bytes:
            raise FieldError(f"has {len(value)} bytes, allowed are {self.min_bytes} to {self.max_bytes}")
        return value

    def pieces(self, number: int, value: Any) -> list[bytes | memoryview]:
        return [delimited(number, len(self.check(value))), *parts_of(value)]


class Choice(Rule):
    """A member of an enum; ``none_if_unspecified`` reads the zero value as None."""

    def __init__(self, kind: type[StrEnum], wire: EnumTypeWrapper, *, none_if_unspecified: bool = False) -> None:
        prefix = "".join(f"_{c}" if c.isupper() else c for c in wire.DESCRIPTOR.name).upper().lstrip("_")
        self._kind = kind
        self._none = none_if_unspecified
        self._number = {member: wire.Value(f"{prefix}_{member.name}") for member in kind}
        self._member = {number: member for member, number in self._number.items()}

    def _to_number(self, value: Any) -> int:
        if value is None and self._none:
            return 0
        if not isinstance(value, self._kind):
            raise FieldError(f"must be a {self._kind.__name__}, not {value!r:.40}")
        return self._number[value]

    def _to_member(self, number: int) -> StrEnum | None:
        if number == 0 and self._none:
            return None
        if number not in self._member:
            raise FieldError("is missing" if number == 0 else f"has the unknown value {number}")
        return self._member[number]

    def put(self, message: Message, name: str, value: Any) -> None:
        setattr(message, name, self._to_number(value))

    def take(self, message: Message, name: str) -> Any:
        return self._to_member(getattr(message, name))

    def extend(self, container: Any, values: Any) -> None:
        container.extend([self._to_number(value) for value in values])

    def collect(self, container: Any) -> list[Any]:
        return [self._to_member(number) for number in container]


@dataclass(frozen=True)
class Sub(Rule):
    """A nested dataclass; ``optional`` reads an absent one as None."""

    plan: Plan
    optional: bool = False

    def put(self, message: Message, name: str, value: Any) -> None:
        if value is None and self.optional:
            return
        child = getattr(message, name)
        child.SetInParent()
        self.plan.fill(child, value)

    def take(self, message: Message, name: str) -> Any:
        if not message.HasField(name):
            if self.optional:
                return None
            raise FieldError("is missing")
        return self.plan.read(getattr(message, name))

    def extend(self, container: Any, values: Any) -> None:
        for index, value in enumerate(values):
            try:
                self.plan.fill(container.add(), value)
            except FieldError as error:
                raise error.at(f"[{index}]") from None

    def collect(self, container: Any) -> list[Any]:
        out = []
        for index, child in enumerate(container):
            try:
                out.append(self.plan.read(child))
            except FieldError as error:
                raise error.at(f"[{index}]") from None
        return out

    def take_lifted(self, message: Message, name: str, contents: tuple[memoryview, ...]) -> Any:
        if not message.HasField(name):
            raise FieldError("is missing")
        return self.plan.read(getattr(message, name), contents)

    def pieces(self, number: int, value: Any) -> list[bytes | memoryview]:
        inner = self.plan.pieces(value, self.plan.message())
        return [delimited(number, sum(map(len, inner))), *inner]


@dataclass(frozen=True)
class OptionalText(Rule):
    """A proto3 ``optional string``; absent is None."""

    rule: Text

    def put(self, message: Message, name: str, value: Any) -> None:
        if value is not None:
            setattr(message, name, self.rule.check(value))

    def take(self, message: Message, name: str) -> Any:
        return self.rule.check(getattr(message, name)) if message.HasField(name) else None


@dataclass(frozen=True)
class Many(Rule):
    """A repeated field as a tuple of bounded length."""

    rule: Rule
    max_count: int
    min_count: int = 0

    def _check_count(self, count: int) -> None:
        if not self.min_count <= count <= self.max_count:
            raise FieldError(f"has {count} elements, allowed are {self.min_count} to {self.max_count}")

    def put(self, message: Message, name: str, value: Any) -> None:
        if not isinstance(value, tuple):
            raise FieldError(f"must be a tuple, not {type(value).__name__}")
        self._check_count(len(value))
        self.rule.extend(getattr(message, name), value)

    def take(self, message: Message, name: str) -> Any:
        container = getattr(message, name)
        self._check_count(len(container))
        return tuple(self.rule.collect(container))

    def take_lifted(self, message: Message, name: str, contents: tuple[memoryview, ...]) -> Any:
        self._check_count(len(contents))
        return tuple(self.rule.collect(contents))

    def pieces(self, number: int, value: Any) -> list[bytes | memoryview]:
        if not isinstance(value, tuple):
            raise FieldError(f"must be a tuple, not {type(value).__name__}")
        self._check_count(len(value))
        return [piece for element in value for piece in self.rule.pieces(number, element)]


@dataclass(frozen=True)
class Table(Rule):
    """A map from short names to values."""

    rule: Rule
    max_count: int = 256
    key: Rule = field(default_factory=lambda: Text(max_chars=256, min_chars=1))

    def _entries(self, items: Mapping[str, Any]) -> dict[str, Any]:
        if len(items) > self.max_count:
            raise FieldError(f"has {len(items)} entries, allowed are {self.max_count}")
        out = {}
        for name in sorted(items):
            try:
                out[self.key.check(name)] = self.rule.check(items[name])
            except FieldError as error:
                raise error.at(f"[{name!r:.40}]") from None
        return out

    def put(self, message: Message, name: str, value: Any) -> None:
        if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
            raise FieldError("must be a mapping with text keys")
        getattr(message, name).update(self._entries(value))

    def take(self, message: Message, name: str) -> Any:
        return self._entries(getattr(message, name))


@dataclass(frozen=True)
class Array(Rule):
    """A small float64 array as repeated doubles, row-major, finite; ``test`` returns what is wrong with it, or None."""

    shape: tuple[int, ...]
    test: Callable[[list[float]], str | None] = lambda _: None

    def _check(self, values: list[float]) -> None:
        if not all(map(math.isfinite, values)):
            raise FieldError("must be finite")
        problem = self.test(values)
        if problem is not None:
            raise FieldError(problem)

    def put(self, message: Message, name: str, value: Any) -> None:
        if not isinstance(value, np.ndarray) or value.shape != self.shape or value.dtype.kind != "f":
            raise FieldError(f"must be a float array of shape {self.shape}")
        values = (value.astype(np.float64) + 0.0).ravel().tolist()
        self._check(values)
        getattr(message, name).extend(values)

    def take(self, message: Message, name: str) -> Any:
        values = list(getattr(message, name))
        if len(values) != math.prod(self.shape):
            raise FieldError(f"has {len(values)} numbers, {math.prod(self.shape)} are needed")
        self._check(values)
        return np.array(values, dtype=np.float64).reshape(self.shape)


class Plan:
    """How one dataclass is moved to and from its message."""

    def __init__(
        self,
        record: type[Any],
        message: type[Message],
        rules: Mapping[str, Rule],
        *,
        test: Callable[[Any], str | None] = lambda _: None,
        informative: tuple[str, ...] = (),
        bulk: str | None = None,
        max_bytes: int = 2**20,
    ) -> None:
        """Bind.

        Args:
            record: the frozen dataclass.
            message: the generated class.
            rules: one for each field of ``record``.
            test: looks at the whole record and returns what is wrong with it, or None.
            informative: fields that are not part of the record's identity.
            bulk: the field that may hold megabytes: it comes last on the wire, copied once on the way out and not at
                all on the way in.
            max_bytes: longest encoded message that is decoded at all.
        """
        names = {entry.name for entry in fields(record)}
        if names != set(rules):
            raise TypeError(f"{record.__name__}: rules for {sorted(names ^ set(rules))} are missing or superfluous")
        self.record = record
        self.message = message
        self.informative = informative
        self.max_bytes = max_bytes
        self.full_name: str = message.DESCRIPTOR.full_name
        self._rules = tuple(rules.items())
        self._head = tuple((name, rule) for name, rule in self._rules if name != bulk)
        numbers = {entry.name: entry.number for entry in message.DESCRIPTOR.fields}
        self._tail = tuple((name, numbers[name], rule) for name, rule in self._rules if name == bulk)
        self._test = test
        self.has_bulk = bulk is not None
        self._leading: dict[type[Any], list[tuple[str, Plan]]] = {}

    @property
    def bulk_field(self) -> tuple[int, Rule]:
        """Number and rule of the bulk field."""
        ((_, number, rule),) = self._tail
        return number, rule

    def fill(self, message: Message, record: Any) -> None:
        """Move a record into an empty message."""
        self._fill(message, record, self._rules)

    def read(self, message: Message, lifted: tuple[memoryview, ...] | None = None) -> Any:
        """Make the record of a message; ``lifted`` is what its bulk field held."""
        values = {}
        for name, rule in self._rules:
            try:
                if lifted is not None and name == self._tail[0][0]:
                    values[name] = rule.take_lifted(message, name, lifted)
                else:
                    values[name] = rule.take(message, name)
            except FieldError as error:
                raise error.at(name) from None
        record = self.record(**values)
        self._check(record)
        return record

    def parts(self, record: Any, cls: type[Part]) -> list[Part]:
        """Every value of a class within a record, in order of appearance."""
        found: list[Part] = []
        for name, plan in self._fields_leading_to(cls):
            value = getattr(record, name)
            for entry in value if isinstance(value, tuple) else (value,):
                if isinstance(entry, cls):
                    found.append(entry)
                elif entry is not None:
                    found += plan.parts(entry, cls)
        return found

    def _fields_leading_to(self, cls: type[Any]) -> list[tuple[str, Plan]]:
        if cls not in self._leading:
            inner = [(name, rule.rule if isinstance(rule, Many) else rule) for name, rule in self._rules]
            subs = [(name, rule.plan) for name, rule in inner if isinstance(rule, Sub)]
            self._leading[cls] = [(name, sub) for name, sub in subs if sub.record is cls or sub._fields_leading_to(cls)]
        return self._leading[cls]

    def pieces(self, record: Any, message: Message) -> list[bytes | memoryview]:
        """A record as bytes that are to be joined, by way of an empty message; equal records give equal bytes.

        Raises:
            FieldError: a value breaks a rule.
            google.protobuf.message.EncodeError: what no rule forbids, but protobuf does.
        """
        self._fill(message, record, self._head)
        pieces: list[bytes | memoryview] = [message.SerializeToString(deterministic=True)]
        for name, number, rule in self._tail:
            try:
                pieces += rule.pieces(number, getattr(record, name))
            except FieldError as error:
                raise error.at(name) from None
        return pieces

    def _fill(self, message: Message, record: Any, rules: Iterable[tuple[str, Rule]]) -> None:
        if not isinstance(record, self.record):
            raise FieldError(f"must be a {self.record.__name__}, not {type(record).__name__}")
        for name, rule in rules:
            try:
                rule.put(message, name, getattr(record, name))
            except FieldError as error:
                raise error.at(name) from None
        self._check(record)

    def _check(self, record: Any) -> None:
        problem = self._test(record)
        if problem is not None:
            raise FieldError(problem)
