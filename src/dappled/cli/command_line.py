"""Make the command line from the verbs' fields, and read a call into a verb; nothing but the wanted verb is loaded."""

from __future__ import annotations

import argparse
import importlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import MISSING, Field, dataclass, fields
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NoReturn, Union, get_args, get_origin, get_type_hints

import dappled
from dappled import codec
from dappled.cli import table
from dappled.cli.table import GROUPS, VERBS
from dappled.cli.verb import Argument, Verb
from dappled.errors import CallError, DappledError
from dappled.shown import printable

_LAST = {"anyway": 1, "overwrite": 2, "json": 3}


class CommandParser(argparse.ArgumentParser):
    """A parser that shows a one-line usage with an error, and names the nearest of the words that it knows."""

    def short_usage(self) -> str:
        """The call in a line: what it needs, and "[options]"."""
        shown = [one for one in self._actions if one.required or not one.option_strings]
        usage = argparse.HelpFormatter(self.prog, width=10_000)
        usage.add_usage(None, shown, self._mutually_exclusive_groups[:0])
        more = "" if len(shown) == len(self._actions) else " [options]"
        return f"{usage.format_help().strip()}{more}  ({self.prog} --help says all)"

    def error(self, message: str) -> NoReturn:
        """Print usage and what is wrong, and exit with 2."""
        self.exit(2, f"{self.short_usage()}\n{self.prog}: {printable(message)}\n")

    def refuse_unknown(self, word: str) -> NoReturn:
        """End a call with an option or word that this verb hasn't."""
        known = [name for action in self._actions for name in action.option_strings if name.startswith("--")]
        self.error(f"there is no {word!r} here{nearest(word.partition('=')[0], known)}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            known = [str(one) for one in action.choices]
            hint = nearest(str(value), known) or f"; known are {', '.join(known)}"
            raise argparse.ArgumentError(action if action.option_strings else None, f"there is no {value!r} here{hint}")


def nearest(word: str, known: Iterable[str]) -> str:
    """Words that name the nearest of the known ones; "" where none is near."""
    near = codec.nearest(word, known, 0.5)
    return f"; did you mean {near!r}?" if near else ""


class _LeftOut:
    """Stands for the parser of a verb that the call doesn't name: to make 50 of them takes argparse 50 ms."""

    def add_subparsers(self, **_: object) -> _LeftOut:
        return self

    def add_parser(self, *_: object, **__: object) -> _LeftOut:
        return self


@dataclass(frozen=True, slots=True)
class Call:
    """A command line that was read: the verb with its arguments, the words that name it, and --debug."""

    path: str
    verb: Verb
    debug: bool
    usage: str


def verb_class(path: str) -> type[Verb]:
    """The class of a verb, by its words."""
    name, _, made = VERBS[path][0].partition(":")
    try:
        module = importlib.import_module(f"dappled.cli.{name}")
    except NameError:  # one of its words is what was left out: with all of it the help is slow, and whole
        table.words_only = False
        module = importlib.import_module(f"dappled.cli.{name}")
    found: type[Verb] = getattr(module, made)
    return found


def read(words: Sequence[str]) -> Call:
    """Read a call. Raises SystemExit: 2 for a wrong one, 0 where --help or --version was asked for."""
    named = [word for word in words if not word.startswith("-")][:2]
    path = " ".join(named) if " ".join(named) in VERBS else named[0] if named else ""
    parsed, unknown = parser(path).parse_known_args(words)
    one: CommandParser = parsed.parser
    if unknown:
        one.refuse_unknown(unknown[0])
    made = verb_class(path)
    values = {spec.name: _plain(spec, getattr(parsed, spec.name)) for spec in fields(made)}
    return Call(path, made(**values), parsed.debug, one.short_usage())


def check(verb: Verb) -> None:
    """Refuse what is wrong by itself: files that are not there, what the verb refuses, files of another kind.

    Raises DappledError.
    """
    named = list(_named(verb))
    for path, _ in named:
        try:
            path.stat()
        except (FileNotFoundError, NotADirectoryError):
            raise CallError(f"{path}: no such file or folder; check the path") from None
    verb.check()
    for path, there in named:
        with suppress(PermissionError):  # the work says what can't be read
            if not isinstance(there, bool) and (wrong := there(path)):
                raise CallError(wrong)


def _named(verb: Verb) -> Iterator[tuple[Path, Callable[[Path], str] | bool]]:
    """The files and folders that must be there, each with what tells its kind."""
    for spec in fields(verb):
        if there := spec.metadata["argument"].there:
            value = getattr(verb, spec.name)
            for path in value if isinstance(value, tuple) else () if value in (None, "") else (value,):
                yield Path(path), there


def _plain(spec: Field[Any], value: Any) -> Any:
    """A field's value as it was read: words as a tuple; the default where argparse has none."""
    if value is None and spec.default is not MISSING:
        return spec.default
    return tuple(value) if isinstance(value, list) else value


def parser(path: str = "") -> CommandParser:
    """The whole command line. Only the verb of this path has its arguments; of other verbs and groups only the line is
    there that tells of them."""

    def wanted(**given: Any) -> CommandParser | _LeftOut:
        return CommandParser(**given) if f"dappled {path} ".startswith(f"{given['prog']} ") else _LeftOut()

    made: Any = {"parser_class": wanted, "required": True}
    top = CommandParser(
        prog="dappled",
        description="Acquisition daemon for masked light-field cameras that fly.",
        epilog="example: dappled run --simulate --frames 8",
    )
    top.add_argument("--version", action="version", version=f"dappled {dappled.__version__}")
    top.add_argument("--debug", action="store_true", help="show tracebacks and the log's details")
    branches: dict[str, Any] = {"": top.add_subparsers(metavar="VERB", **made)}
    for name, (_, line) in VERBS.items():
        group, _, last = name.rpartition(" ")
        if group not in branches:
            one = branches[""].add_parser(group, **_described(GROUPS[group]))
            branches[group] = one.add_subparsers(metavar="ACTION", **made)
            if path == group:
                own = [verb_class(other).examples[0] for other in VERBS if other.startswith(f"{group} ")]
                one.epilog = _told(own)
        leaf = branches[group].add_parser(last, **_described(line))
        if name == path:
            _fill(leaf, verb_class(name))
    return top


def options(path: str) -> list[str]:
    """What may come after a verb: its long options, actions, and the choices of its arguments."""
    (leaf,) = _leaves(parser(path), path.split())
    names = [name for action in leaf._actions for name in action.option_strings if name.startswith("--")]
    return [*names, *(str(one) for action in leaf._actions for one in action.choices or ())]


def _leaves(one: argparse.ArgumentParser, words: Sequence[str]) -> list[argparse.ArgumentParser]:
    """The parser of a verb below another parser."""
    if not words:
        return [one]
    below = [action.choices for action in one._actions if isinstance(action, argparse._SubParsersAction)]
    return [leaf for choices in below for leaf in _leaves(choices[words[0]], words[1:])]


def _described(line: str) -> dict[str, Any]:
    end = "" if line.endswith("?") else "."
    raw = argparse.RawDescriptionHelpFormatter
    return {"help": line, "description": line[0].upper() + line[1:] + end, "formatter_class": raw}


def _told(examples: Sequence[str], notes: str = "") -> str:
    head = "example:" if len(examples) == 1 else "examples:"
    told = "\n  ".join((head, *examples)).replace("%", "%%")
    return f"{told}\n\n{notes}".rstrip() if notes else told


def _fill(one: CommandParser, made: type[Verb]) -> None:
    """Add the fields of a verb as arguments; what many have comes last."""
    one.epilog = _told(made.examples, made.notes)
    one.set_defaults(parser=one)
    hints = get_type_hints(made)
    groups: dict[str, Any] = {"": one}
    alone: dict[str, Any] = {}
    for spec in sorted(fields(made), key=_place):
        form: Argument = spec.metadata["argument"]
        if form.group not in groups:
            groups[form.group] = one.add_argument_group(form.group)
        home = groups[form.group]
        if form.alone:
            home = alone.setdefault(
                form.alone, home.add_mutually_exclusive_group() if form.alone not in alone else home
            )
        _add(home, spec, form, hints[spec.name])


def _place(spec: Field[Any]) -> int:
    return -1 if spec.metadata["argument"].first else _LAST.get(spec.name, 0)


def _add(home: Any, spec: Field[Any], form: Argument, hint: Any) -> None:
    inner = [one for one in get_args(hint) if one is not NoneType] if get_origin(hint) in (Union, UnionType) else [hint]
    kind, rule = str if get_origin(inner[0]) is Literal else inner[0], form.rule
    given: dict[str, Any] = {"help": _help(spec, form).replace("%", "%%")}
    default = None if spec.default is MISSING else spec.default
    if kind is bool:
        optional = len(get_args(hint)) > 1
        given |= {"action": argparse.BooleanOptionalAction} if optional else {"action": "store_true"}
        home.add_argument(*form.names, dest=spec.name, default=default, **given)
        return
    if get_origin(kind) is tuple and (form.parse is None or form.append):
        parts = get_args(kind)
        kind = parts[0]
        if form.append:
            given["action"] = "append"
        else:
            given["nargs"] = (
                len(parts) if parts[-1] is not Ellipsis else "+" if spec.default is MISSING or form.names else "*"
            )
    elif not form.names and spec.default is not MISSING:
        given["nargs"] = "?"
    if form.const is not None:
        given |= {"nargs": "?", "const": form.const}
    given["type"] = _parser_of(kind, form)
    if rule.choices:
        given["choices"] = rule.choices
    if form.metavar is not None or not rule.choices:
        given["metavar"] = form.metavar or _letter(kind, rule.unit)
    if form.append and default == ():
        default = None
    if form.names:
        home.add_argument(*form.names, dest=spec.name, default=default, required=spec.default is MISSING, **given)
    else:
        home.add_argument(spec.name, default=default, **given)


def _letter(kind: type, unit: str) -> str:
    return unit.upper() if unit and kind in (int, float) else {int: "N", float: "N", str: "P"}.get(kind, "FILE")


def _help(spec: Field[Any], form: Argument) -> str:
    """The meaning, and what holds where it isn't given."""
    otherwise = form.otherwise
    if not otherwise and form.names and spec.default not in (MISSING, None, False, (), "", math.inf):
        shown = " ".join(map(str, spec.default)) if isinstance(spec.default, tuple) else f"{spec.default}"
        otherwise = shown if not isinstance(spec.default, float) else f"{spec.default:g}"
    unit = f", {form.rule.unit}" if form.rule.unit and not otherwise else ""
    return f"{form.rule.text}{unit}" + (f" (default: {otherwise})" if otherwise else "")


def _parser_of(kind: Any, form: Argument) -> Callable[[str], Any]:
    """What reads one word. Raises ArgumentTypeError with what the word should be."""
    if form.parse is None and kind not in (int, float):
        read_one: Callable[[str], Any] = kind
        return read_one

    def read_word(text: str) -> Any:
        try:
            return _number(text, kind, form) if form.parse is None else form.parse(text)
        except (ValueError, DappledError) as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read_word


def _number(text: str, kind: type, form: Argument) -> float | int:
    """A number within its rule. Raises ValueError with what it should be."""
    rule = form.rule
    try:
        number: float | int = kind(text)
    except ValueError:
        number = math.nan
    low_enough = number >= rule.low if form.above is None else number > form.above
    if low_enough and number <= rule.high and (isinstance(number, int) or math.isfinite(number) or form.infinite):
        return number
    what = "a whole number" if kind is int else "a number"
    unit = f" {rule.unit}" if rule.unit else ""
    if form.above is not None:
        limit = f" above {form.above:g}{unit}"
    elif math.isfinite(rule.low) and math.isfinite(rule.high):
        limit = f" from {rule.low:g} to {rule.high:g}{unit}"
    elif math.isfinite(rule.low):
        limit = f" from {rule.low:g}{unit}"
    else:
        limit = f" in{unit}" if unit else ""
    raise ValueError(f"{text!r} is not {what}{limit}{', or inf' if form.infinite else ''}")
