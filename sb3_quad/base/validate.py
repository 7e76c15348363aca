"""Validated data: one base class for records and settings, and one-line errors."""

import math
import re
import typing
from collections.abc import Callable, Iterable
from typing import Annotated, Any, ClassVar, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PydanticUserError,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from sb3_quad.base.errors import ConfigError, refuse_unknown
from sb3_quad.base.types import StrMapping

Model = TypeVar("Model", bound=BaseModel)
# The kinds of arguments that a constructor's annotations name
Count = Annotated[int, Field(ge=1)]
Natural = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Weight = Annotated[float, Field(ge=0.0)]
# A quantity of a vehicle in SI units. None is larger or smaller, and ratios of their squares do not
# overflow.
LARGEST = 1e6
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Quantity = Annotated[float, Field(ge=1e-12, le=LARGEST)]
_EXPECTED = {
    "callable": "a number or lin_<number>",
    "float": "a number",
    "int": "a whole number",
}
"""How a value must be, by the kind of pydantic's error; the first that applies."""
# Names of a union's alternatives in the place of an error: `int`, `list[str]`, `Vehicle`
_ALTERNATIVE = re.compile(r"int|float|str|bool|none|literal|[A-Z]\w+|.*[\[(].*")
# Annotations that take true and false
_TAKES_BOOL = re.compile("bool|Any")
# The most keys that a line names
_MOST_NAMED = 20
_CHECKS = ConfigDict(arbitrary_types_allowed=True, allow_inf_nan=False)


class Frozen(BaseModel):
    """A record: frozen, with finite numbers and no unknown keys."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )
    short_keys: ClassVar[tuple[str, ...]] = ()
    """keys that a subclass replaces by fields before this class sees them"""

    @field_validator("*", mode="before")
    @classmethod
    def _true_is_no_number(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse true and false for numbers, which pydantic would read as 1 and 0."""
        if _holds_bool(value):
            kind = cls.model_fields[str(info.field_name)].annotation
            if not _TAKES_BOOL.search(str(kind)):
                raise ValueError("true and false are not numbers")
        return value

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, given: Any) -> Any:
        """Name the nearest key, which pydantic would not."""
        if isinstance(given, dict):
            refuse_unknown("key", given, {*cls.model_fields, *cls.short_keys})
        return given

    def __repr_name__(self) -> str:
        """Leave out the types of a generic class."""
        return type(self).__name__.partition("[")[0]

    def __repr_args__(self) -> Iterable[tuple[str | None, Any]]:
        """Leave out what has its default."""
        for name, value in super().__repr_args__():
            if name is None or value != type(self).model_fields[name].default:
                yield name, value


def _holds_bool(value: Any) -> bool:
    """Whether a value is true or false, or a list with one of them."""
    if isinstance(value, (list, tuple)):
        return any(map(_holds_bool, value))
    return isinstance(value, bool)


def validate(model: type[Model], data: Any, where: str | Callable[[str], str]) -> Model:
    """Return ``data`` as a ``model``.

    :param where: The source of the data for the error message, such as the name of its file. It may
        be a function that returns the source of a key.
    :raises ConfigError: Something does not fit. One line names each key, what is wrong, and the
        nearest valid key. If all errors are of one subclass of ConfigError, such as
        :class:`CannotHover`, that subclass is raised.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        if not isinstance(where, str):
            location = error.errors()[0]["loc"] or ("",)
            where = where(str(location[0]))
        raise _kind(error)(f"{where}: {explain(error)}") from None


def _kind(error: ValidationError) -> type[ConfigError]:
    """Return the subclass of ConfigError that all errors share, otherwise ConfigError."""
    kinds = {type(item.get("ctx", {}).get("error")) for item in error.errors()}
    kind = kinds.pop()
    if not kinds and issubclass(kind, ConfigError):
        return kind
    return ConfigError


def check_arguments(owner: type, given: StrMapping) -> None:
    """Check arguments by the annotations of a constructor.

    :param owner: the class. Names that its ``__init__`` does not have are left alone.
    :raises ConfigError: one line names the argument, its value and what it must be.
    """
    for name, kind in typing.get_type_hints(owner.__init__, include_extras=True).items():  # type: ignore[misc]
        # Infinity is no limit, as PyTorch understands it.
        if name in given and not _is_infinite(given[name]):
            check(kind, given[name], name, strict=True)


def _is_infinite(value: Any) -> bool:
    return isinstance(value, float) and value == math.inf


def check(kind: Any, value: Any, where: str, strict: bool = False) -> Any:
    """Return ``value`` as the type ``kind``, by pydantic.

    :param strict: whether to refuse what would have to be converted, such as a number in quotes.
    :raises ConfigError: it is of another type or out of range; the message says what it must be.
    """
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{where} is {value}, must be finite")
    try:
        # True is not 1.
        return TypeAdapter(kind, config=_CHECKS).validate_python(
            value, strict=strict or isinstance(value, bool)
        )
    except PydanticUserError:
        # A type that pydantic cannot check.
        return value
    except ValidationError as error:
        # A union has one error for each of its types: by "int", "float", "callable", …
        messages = {item["type"].partition("_")[0]: item["msg"] for item in error.errors()}
    # rl_zoo3 imports classes by their names, so a string may stand for a class.
    if isinstance(value, str) and "is" in messages:
        return value
    ranges = [messages[kind] for kind in ("greater", "less") if kind in messages]
    known = [text for kind, text in _EXPECTED.items() if kind in messages]
    # Pydantic's own messages are good enough for the others.
    expected = [*ranges, *known, *messages.values()][0].removeprefix("Input should be ")
    raise ConfigError(f"{where} is {value!r}, must be {expected}")


def explain(error: ValidationError) -> str:
    """Return one line that says for each key what is wrong."""
    lines: dict[str, str] = {}
    for item in error.errors():
        # The user knows the keys, and not the names of the alternatives of a union.
        parts = [str(part) for part in item["loc"]]
        key = ".".join(part for part in parts if not _ALTERNATIVE.fullmatch(part))
        text = str(item["msg"]).removeprefix("Value error, ")
        if not text.startswith(key):
            text = f"{key}: {text}"
        # Each alternative of a union has its own errors. Only those of the first one are shown.
        lines.setdefault(key, text)
    return "; ".join([*lines.values()][:_MOST_NAMED])
