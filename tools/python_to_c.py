"""Translate functions over records (``skyless.core.native.records``) from Python to C, with the same bits.

What it takes: functions whose parameters and result have types; numbers, records, and their arrays of fixed length.

    types        int (32 bits), Ticks and Count (64 bits), Byte, bool, float (C's ``real``), records (by reference),
                 ``Array[Record]``, ``Reals``, ``Integers``, ``Bytes``, ``Annotated[Matrix, N, M]``;
                 as a result also ``tuple`` of numbers
    statements   assignments, also several at once, with an operator or with a type; ``if``, ``while``,
                 ``for … in range(…)``, ``break``, ``continue``, ``return``, ``pass``, calls
    expressions  arithmetic, comparisons, ``in (A, B)``, ``and``, ``or``, ``not``, ``x if c else y``, attributes,
                 subscripts, calls of other such functions and of ``abs``, ``min``, ``max``, ``int``, ``float``,
                 ``sqrt``; constants of modules; ``Record()`` as the value of a new variable

All else is refused with file, line and reason. ``//`` and ``%`` round down as in Python; ``min`` and ``max`` give the
first of equals; a bound of a range is looked up once. A variable keeps the type of its first value; what is an element
of an array or a field of a record, and no number, is a reference, as in Python. Whole numbers are assumed to fit, and
divisors not to be zero. Docstrings and comments come along.

``make_core.py`` makes the files of ``skyless.core.native`` with it.
"""

import ast
import inspect
import io
import math
import sys
import textwrap
import tokenize
from collections.abc import Callable, Iterator, Sequence
from ctypes import Array, c_bool, c_double, c_int32, c_int64, c_uint8
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, Final, NamedTuple, get_args, get_origin, get_type_hints

from skyless.core.native import arithmetic
from skyless.core.native.records import Record, c_type

WIDTH: Final = 120
INDENT: Final = "    "
RESERVED: Final = frozenset(
    "exp log hypot floor sqrt index remove auto case char const default do double enum extern float goto inline int "
    "long register restrict short signed sizeof static struct switch typedef union unsigned void volatile real".split()
)
"""Names that mean something else in C; an underscore is appended."""


class Refused(Exception):
    """A place that cannot be translated."""


# Types


class Number(NamedTuple):
    """A type of numbers, by its name in C."""

    name: str


BOOL, INT, LONG, BYTE, REAL = (Number(name) for name in ("bool", "int32_t", "int64_t", "uint8_t", "real"))
OF_CTYPE: Final = {c_bool: BOOL, c_int32: INT, c_int64: LONG, c_uint8: BYTE, c_double: REAL}


class Struct(NamedTuple):
    """A record."""

    made: type[Record]


class Elements(NamedTuple):
    """An array; where it is a parameter, its length is not known."""

    element: "Type"
    length: int


class Results(NamedTuple):
    """Several numbers that a function returns."""

    function: str
    items: tuple[Number, ...]


Type = Number | Struct | Elements | Results


def type_of(ctype: Any) -> Type:  # noqa: ANN401 - ctypes have no common type
    """The type of a ctype."""
    if ctype in OF_CTYPE:
        return OF_CTYPE[ctype]
    if issubclass(ctype, Array):
        return Elements(type_of(ctype._type_), ctype._length_)
    return Struct(ctype)


def declared(kind: Type, name: str) -> str:
    """The declaration of a variable or parameter; arrays and records are references."""
    if isinstance(kind, Number):
        return f"{kind.name} {name}"
    if isinstance(kind, Results):
        return f"{kind.function}_results {name}"
    if isinstance(kind, Struct):
        return f"{kind.made.__name__} *{name}"
    lengths, element = "", kind.element
    while isinstance(element, Elements):
        lengths, element = f"{lengths}[{element.length}]", element.element
    base = element.name if isinstance(element, Number) else element.made.__name__  # type: ignore[union-attr]
    return f"{base} (*{name}){lengths}" if lengths else f"{base} *{name}"


def parameter_type(hint: Any) -> Type:  # noqa: ANN401
    """The type of an annotation of a parameter or result."""
    if get_origin(hint) is tuple:
        return Results("", tuple(type_of(c_type(item)) for item in get_args(hint)))  # type: ignore[arg-type]
    origin = get_origin(hint)
    if origin is not None and origin.__name__ in {"Array", "Sequence"}:
        return Elements(parameter_type(get_args(hint)[0]), 0)
    return type_of(c_type(hint))


# Values


class Value(NamedTuple):
    """An expression in C."""

    code: str
    kind: Type
    rank: int = 20
    """How closely its operator binds, as in C; 20 where there is none."""
    is_pointer: bool = True
    """Of a record: whether it is a reference, and not the record itself."""


def as_operand(value: Value, rank: int) -> str:
    """Its code where an operator of a rank stands beside it."""
    return value.code if value.rank >= rank else f"({value.code})"


def converted(value: Value, kind: Type) -> Value:
    """The value as a number of a type."""
    if value.kind == kind or kind != REAL:
        return value
    return Value(f"(real){as_operand(value, 15)}", REAL, 15)


# Modules


class Source(NamedTuple):
    """A module's text, taken apart."""

    module: ModuleType
    nodes: dict[str, ast.FunctionDef | ast.ClassDef]
    docs: dict[str, str]
    """Of constants."""
    comments: dict[int, tuple[bool, str]]
    """By line: whether it stands alone, and its text."""


def source_of(module: ModuleType, known: dict[str, Source] = {}) -> Source:  # noqa: B006 - a cache
    """The text of a module."""
    if module.__name__ not in known:
        text = inspect.getsource(module)
        body = ast.parse(text).body
        nodes = {node.name: node for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        docs, comments = {}, {}
        for node, behind in zip(body, body[1:], strict=False):
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and (doc := doc_of(behind)):
                docs[node.target.id] = doc
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT and "noqa" not in token.string:
                comments[token.start[0]] = (not token.line[: token.start[1]].strip(), token.string[1:].strip())
        known[module.__name__] = Source(module, nodes, docs, comments)
    return known[module.__name__]


def doc_of(node: ast.stmt) -> str:
    """The text of a statement that is nothing but a text."""
    is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    return inspect.cleandoc(node.value.value) if is_text else ""  # type: ignore[union-attr,arg-type]


def c_name(name: str) -> str:
    """A name as C has it."""
    name = name.lstrip("_")
    return f"{name}_" if name in RESERVED else name


def comment(text: str, indent: str = "") -> list[str]:
    """A comment of one or more lines."""
    if "\n" not in text and len(indent) + len(text) + 6 <= WIDTH:
        return [f"{indent}/* {text} */"]
    lines = [f"{indent} * {line}".rstrip() for line in text.split("\n")]
    lines[0] = f"{indent}/* {text.split(chr(10))[0]}"
    return [*lines[:-1], f"{lines[-1]} */"] if len(lines) > 1 else [f"{lines[0]} */"]


def wrapped(line: str) -> list[str]:
    """A line of code in lines that are short enough."""
    if len(line) <= WIDTH or "/*" in line:
        return [line]
    indent = line[: len(line) - len(line.lstrip())]
    return textwrap.wrap(
        line, WIDTH, initial_indent="", subsequent_indent=indent + 2 * INDENT, break_long_words=False,
        break_on_hyphens=False, drop_whitespace=True,
    )  # fmt: skip


# A function


class Translator:
    """All that is translated, as far as it is known that it is needed."""

    def __init__(self, roots: Sequence[Callable[..., Any]]) -> None:
        self.roots = {root.__name__ for root in roots}
        self.functions: dict[str, FunctionType] = {}
        self.records: dict[str, type[Record]] = {}
        self.constants: dict[str, tuple[Any, str]] = {}
        self.bodies: dict[str, list[str]] = {}
        self.results: dict[str, Results] = {}
        for root in roots:
            self.need(root)  # type: ignore[arg-type]

    def need(self, function: FunctionType) -> str:
        """The name in C of a function, which is translated as well."""
        name = c_name(function.__name__)
        known = self.functions.setdefault(name, function)
        if known is not function:
            raise Refused(f"two functions are called {name}: in {known.__module__} and {function.__module__}")
        if name not in self.bodies:
            self.bodies[name] = []
            self.bodies[name] = Body(self, function).lines
        return f"skyless_{name}" if function.__name__ in self.roots else name

    def need_record(self, made: type[Record]) -> None:
        """A record is needed, and those in it before."""
        if made.__name__ not in self.records:
            for _, ctype in made._fields_:  # type: ignore[misc]
                kind = type_of(ctype)
                while isinstance(kind, Elements):
                    kind = kind.element
                if isinstance(kind, Struct):
                    self.need_record(kind.made)
            self.records[made.__name__] = made

    def signature(self, function: FunctionType) -> tuple[list[tuple[str, Type]], Type | None]:
        """Names and types of parameters, and the type of the result."""
        hints = get_type_hints(function, include_extras=True)
        returned = hints.pop("return")
        parameters = [(name, parameter_type(hint)) for name, hint in hints.items()]
        for _, kind in parameters:
            element = kind
            while isinstance(element, Elements):
                element = element.element
            if isinstance(element, Struct):
                self.need_record(element.made)
        if returned is type(None):
            return parameters, None
        kind = parameter_type(returned)
        if isinstance(kind, Results):
            kind = self.results[c_name(function.__name__)] = Results(c_name(function.__name__), kind.items)
        return parameters, kind

    def head(self, function: FunctionType) -> str:
        """The declaration of a function."""
        parameters, returned = self.signature(function)
        listed = ", ".join(declared(kind, c_name(name)) for name, kind in parameters)
        name = c_name(function.__name__)
        is_root = function.__name__ in self.roots
        found = "void " if returned is None else declared(returned, "")
        return f"{'SKYLESS_EXPORT' if is_root else 'INTERNAL'} {found}{'skyless_' if is_root else ''}{name}({listed})"


class Body:
    """The body of one function."""

    def __init__(self, translator: Translator, function: FunctionType) -> None:
        self.all, self.function = translator, function
        self.source = source_of(inspect.getmodule(function))  # type: ignore[arg-type]
        self.globals = function.__globals__
        parameters, self.returned = translator.signature(function)
        self.kinds: dict[str, tuple[Type, bool]] = {name: (kind, True) for name, kind in parameters}
        node = self.source.nodes[function.__name__]
        statements = node.body[1:] if doc_of(node.body[0]) else node.body
        self.scopes = Scopes(statements, [name for name, _ in parameters])
        self.variables = {c_name(one.id) for one in _flat(list(_uses(statements))) if isinstance(one.ctx, ast.Store)}
        self.last_line = statements[0].lineno - 1
        self.temporaries = 0
        self.hoisted: list[str] = []
        body = list(self.block(statements, INDENT))
        self.lines = [*(f"{INDENT}{one}" for one in self.hoisted), *body]

    def refuse(self, node: ast.AST, reason: str) -> Refused:
        """The error for a place."""
        line = getattr(node, "lineno", 0)
        return Refused(f"{self.source.module.__file__}:{line}: {reason}: {ast.unparse(node)[:80]}")

    # Statements

    def block(self, statements: Sequence[ast.stmt], indent: str) -> Iterator[str]:
        """The lines of some statements."""
        for statement in statements:
            for line in range(self.last_line + 1, statement.lineno):
                stands_alone, text = self.source.comments.get(line, (False, ""))
                if stands_alone:
                    yield from comment(text, indent)
            is_compound = isinstance(statement, ast.If | ast.For | ast.While)
            end = statement.lineno if is_compound else statement.end_lineno or statement.lineno
            self.last_line = end
            texts = [self.source.comments[line][1] for line in range(statement.lineno, end + 1)
                     if line in self.source.comments]  # fmt: skip
            lines = [part for line in self.statement(statement, indent) for part in wrapped(line)]
            if texts:
                lines[0] = f"{lines[0]}  /* {' '.join(texts)} */"
            yield from lines

    def statement(self, node: ast.stmt, indent: str) -> Iterator[str]:  # noqa: PLR0912 - one for each kind
        """The lines of a statement."""
        match node:
            case ast.Assign():
                yield from self.assign(node, indent)
            case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
                kind = parameter_type(evaluated(node.annotation, self.globals))
                yield from self.store(node.target, converted(self.value(value), kind), indent, name, kind)
            case ast.AugAssign():
                yield from self.augmented(node, indent)
            case ast.If():
                yield from self.branches(node, indent, "")
            case ast.For():
                yield from self.loop(node, indent)
            case ast.While(orelse=[]):
                yield f"{indent}while ({self.condition(node.test).code}) {{"
                yield from self.block(node.body, indent + INDENT)
                yield f"{indent}}}"
            case ast.Return(value=value):
                yield from self.give(value, indent)
            case ast.Expr(value=ast.Call()):
                yield f"{indent}{self.call(node.value).code};"  # type: ignore[arg-type]
            case ast.Break():
                yield f"{indent}break;"
            case ast.Continue():
                yield f"{indent}continue;"
            case ast.Pass():
                pass
            case _:
                raise self.refuse(node, f"{type(node).__name__} is not translated")

    def branches(self, node: ast.If, indent: str, before: str) -> Iterator[str]:
        yield f"{indent}{before}if ({self.condition(node.test).code}) {{"
        yield from self.block(node.body, indent + INDENT)
        if len(node.orelse) == 1 and isinstance(node.orelse[0], ast.If):
            self.last_line = node.orelse[0].lineno
            yield from self.branches(node.orelse[0], indent, "} else ")
        elif node.orelse:
            yield f"{indent}}} else {{"
            yield from self.block(node.orelse, indent + INDENT)
            yield f"{indent}}}"
        else:
            yield f"{indent}}}"

    def loop(self, node: ast.For, indent: str) -> Iterator[str]:
        match node:
            case ast.For(target=ast.Name(id=name), iter=ast.Call(func=ast.Name(id="range"), args=limits), orelse=[]):
                pass
            case _:
                raise self.refuse(node, "a loop has to be for NAME in range(…)")
        if name == "_":
            self.temporaries += 1
            name = f"time_{self.temporaries}"
        values = [self.value(limit) for limit in limits]
        begin, end = (Value("0", INT), values[0]) if len(values) == 1 else (values[0], values[1])
        step = evaluated(limits[2], self.globals) if len(limits) == 3 else 1
        kind = LONG if LONG in (begin.kind, end.kind) else INT
        self.kinds[name] = (kind, True)
        variable, limit = c_name(name), end.code
        is_own = id(node.target) in self.scopes.first or name.startswith("time_")
        first = f"{kind.name + ' ' if is_own else ''}{variable} = {begin.code}"
        if not is_own:
            self.hoist(name, kind)
        if self.may_change(limits[0] if len(limits) == 1 else limits[1], node.body):
            limit = f"{variable}_end"
            if is_own:
                first += f", {limit} = {end.code}"
            else:
                yield f"{indent}const {kind.name} {limit} = {end.code};"
        after = {1: f"{variable}++", -1: f"{variable}--"}.get(step, f"{variable} += {step}")
        yield f"{indent}for ({first}; {variable} {'<' if step > 0 else '>'} {limit}; {after}) {{"
        yield from self.block(node.body, indent + INDENT)
        yield f"{indent}}}"

    def may_change(self, limit: ast.expr, body: Sequence[ast.stmt]) -> bool:
        """Whether the bound of a loop may change within it."""
        names = {node.id for node in ast.walk(limit) if isinstance(node, ast.Name)}
        if any(isinstance(node, ast.Call | ast.Attribute | ast.Subscript) for node in ast.walk(limit)):
            return True
        stored = {node.id for one in body for node in ast.walk(one)
                  if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}  # fmt: skip
        return bool(names & stored)

    def give(self, value: ast.expr | None, indent: str) -> Iterator[str]:
        if value is None:
            yield f"{indent}return;"
        elif isinstance(self.returned, Results):
            if not isinstance(value, ast.Tuple):
                raise self.refuse(value, "several results are returned as a tuple")
            items = [
                converted(self.value(item), kind) for item, kind in zip(value.elts, self.returned.items, strict=True)
            ]
            listed = ", ".join(item.code for item in items)
            yield f"{indent}return ({self.returned.function}_results){{{listed}}};"
        else:
            found = self.value(value)
            assert self.returned is not None
            yield f"{indent}return {self.reference(found) if isinstance(found.kind, Struct) else converted(found, self.returned).code};"

    def assign(self, node: ast.Assign, indent: str) -> Iterator[str]:
        if len(node.targets) > 1:
            for target in reversed(node.targets):
                yield from self.store(target, self.value(node.value), indent)
        elif not isinstance(node.targets[0], ast.Tuple):
            yield from self.store(node.targets[0], self.value(node.value), indent)
        elif isinstance(node.value, ast.Tuple):
            yield from self.assign_several(node.targets[0].elts, node.value.elts, indent)
        else:
            found = self.value(node.value)
            if not isinstance(found.kind, Results):
                raise self.refuse(node, "only results of a function are taken apart")
            self.temporaries += 1
            name = f"results_{self.temporaries}"
            yield f"{indent}const {declared(found.kind, name)} = {found.code};"
            for number, (target, kind) in enumerate(zip(node.targets[0].elts, found.kind.items, strict=True)):
                if not (isinstance(target, ast.Name) and target.id == "_"):
                    yield from self.store(target, Value(f"{name}.item_{number}", kind), indent)

    def assign_several(self, targets: list[ast.expr], values: list[ast.expr], indent: str) -> Iterator[str]:
        """``a, b = x, y``: by way of other variables where a later value holds an earlier target."""
        written = [ast.unparse(target) for target in targets]
        later = [{ast.unparse(part) for part in ast.walk(value)} for value in values]
        if not any(written[k] in names for k in range(len(targets)) for names in later[k + 1 :]):
            for target, value in zip(targets, values, strict=True):
                yield from self.store(target, self.value(value), indent)
            return
        found = []
        for value in map(self.value, values):
            self.temporaries += 1
            name = f"new_{self.temporaries}"
            yield f"{indent}const {declared(value.kind, name)} = {value.code};"
            found.append(value._replace(code=name, rank=20))
        for target, value in zip(targets, found, strict=True):
            yield from self.store(target, value, indent)

    def store(
        self, target: ast.expr, value: Value, indent: str, name: str = "", kind: Type | None = None
    ) -> Iterator[str]:
        """Assign a value to a variable, which may be new, to an element or to a field."""
        if isinstance(target, ast.Name):
            name, kind = target.id, kind or value.kind
            if name not in self.kinds or id(target) in self.scopes.first:
                yield from self.declare(name, kind, value, indent)
                return
            known, is_pointer = self.kinds[name]
            if known == INT and value.kind == LONG:
                raise self.refuse(target, f"{name} has 32 bits and is given 64; declare it as Ticks")
            if isinstance(known, Struct) and not is_pointer:
                raise self.refuse(target, f"{name} is a record, and cannot become another")
            code = self.reference(value) if isinstance(known, Struct) else converted(value, known).code
            yield f"{indent}{c_name(name)} = {code};"
            return
        place = self.value(target)
        if isinstance(place.kind, Struct):
            yield f"{indent}{self.record(place)} = {self.record(value)};"
        elif isinstance(place.kind, Elements):
            raise self.refuse(target, "an array cannot be assigned to")
        else:
            yield f"{indent}{place.code} = {converted(value, place.kind).code};"

    def declare(self, name: str, kind: Type, value: Value, indent: str) -> Iterator[str]:
        """A new variable: where it is assigned if all blocks that use it assign it first, else at the beginning."""
        variable = c_name(name)
        if isinstance(kind, Struct) and value.rank == NEW:
            self.kinds[name] = (kind, False)
            yield f"{indent}{kind.made.__name__} {variable} = {{0}};"
            return
        self.kinds[name] = (kind, True)
        code = self.reference(value) if isinstance(kind, Struct) else converted(value, kind).code
        if name in self.scopes.hoisted:
            self.hoist(name, kind)
            yield f"{indent}{variable} = {code};"
        else:
            yield f"{indent}{declared(kind, variable)} = {code};"

    def hoist(self, name: str, kind: Type) -> None:
        """Declare a variable at the beginning."""
        line = f"{declared(kind, c_name(name))} = 0;"
        if line not in self.hoisted:
            self.hoisted.append(line)

    def augmented(self, node: ast.AugAssign, indent: str) -> Iterator[str]:
        place = self.value(node.target)
        plain = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}.get(type(node.op))
        value = self.value(node.value)
        if plain and isinstance(place.kind, Number) and (place.kind != INT or value.kind != LONG):
            if place.kind == REAL or (plain != "/" and value.kind != REAL):
                yield f"{indent}{place.code} {plain}= {converted(value, place.kind).code};"
                return
        whole = ast.BinOp(node.target, node.op, node.value)
        yield from self.store(node.target, self.value(ast.copy_location(whole, node)), indent)

    # Expressions

    def reference(self, value: Value) -> str:
        """The address of a record."""
        return value.code if value.is_pointer else f"&{as_operand(value, 15)}"

    def record(self, value: Value) -> str:
        """A record itself."""
        if value.rank == NEW:
            return f"({value.code}){{0}}"
        return f"*{value.code}" if value.is_pointer else value.code

    def condition(self, node: ast.expr) -> Value:
        """An expression that is true or false."""
        value = self.value(node)
        if value.kind != BOOL:
            raise self.refuse(node, "a condition has to be a comparison or a bool")
        return value

    def value(self, node: ast.expr) -> Value:  # noqa: PLR0911 - one for each kind
        """An expression."""
        match node:
            case ast.Constant(value=bool() as constant):
                return Value("true" if constant else "false", BOOL)
            case ast.Constant(value=int() | float() as constant):
                return literal(constant)
            case ast.Name(id=name):
                return self.name(node, name)
            case ast.Attribute(value=of, attr=field):
                return self.field(node, self.value(of), field)
            case ast.Subscript(value=of, slice=index):
                array, place = self.value(of), self.value(index)
                if not isinstance(array.kind, Elements):
                    raise self.refuse(node, "only arrays have elements")
                return Value(f"{as_operand(array, 16)}[{place.code}]", array.kind.element, 16, False)
            case ast.BinOp():
                return self.operation(node, type(node.op), self.value(node.left), self.value(node.right))
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return Value(f"!{as_operand(self.condition(operand), 15)}", BOOL, 15)
            case ast.UnaryOp(op=ast.USub() | ast.Invert() as sign, operand=operand):
                value = self.value(operand)
                kind = INT if value.kind == BYTE else value.kind
                return Value(f"{'-' if isinstance(sign, ast.USub) else '~'}{as_operand(value, 15)}", kind, 15)
            case ast.BoolOp(op=op, values=parts):
                sign, rank = ("&&", 5) if isinstance(op, ast.And) else ("||", 4)
                listed = [as_operand(self.condition(part), 6) for part in parts]
                return Value(f" {sign} ".join(listed), BOOL, rank)
            case ast.Compare():
                return self.comparison(node)
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return self.choice(self.condition(test), self.value(body), self.value(orelse))
            case ast.Call():
                return self.call(node)
        raise self.refuse(node, f"{type(node).__name__} is not translated")

    def name(self, node: ast.expr, name: str) -> Value:
        if name in self.kinds:
            kind, is_pointer = self.kinds[name]
            return Value(c_name(name), kind, 20, is_pointer)
        constant = self.globals.get(name)
        if not isinstance(constant, bool | int | float):
            raise self.refuse(node, f"{name} is neither a variable that has a value here nor a constant")
        self.all.constants.setdefault(c_name(name), (constant, self.source.docs.get(name, "")))
        return literal(constant)._replace(code=c_name(name), rank=20)

    def field(self, node: ast.expr, of: Value, field: str) -> Value:
        if not isinstance(of.kind, Struct):
            raise self.refuse(node, "only records have fields")
        self.all.need_record(of.kind.made)
        ctype = dict(of.kind.made._fields_).get(field)  # type: ignore[arg-type,misc,var-annotated]
        if ctype is None:
            raise self.refuse(node, f"{of.kind.made.__name__} has no field {field}")
        return Value(f"{as_operand(of, 16)}{'->' if of.is_pointer else '.'}{c_name(field)}", type_of(ctype), 16, False)

    def operation(self, node: ast.expr, op: type[ast.operator], left: Value, right: Value) -> Value:
        if not (isinstance(left.kind, Number) and isinstance(right.kind, Number)):
            raise self.refuse(node, "arithmetic is for numbers")
        kind = common(left.kind, right.kind)
        if op is ast.Div:
            kind = REAL
        if op in (ast.Add, ast.Sub, ast.Mult, ast.Div):
            sign, rank = {ast.Add: ("+", 12), ast.Sub: ("-", 12), ast.Mult: ("*", 13), ast.Div: ("/", 13)}[op]
            ours, theirs = converted(left, kind), converted(right, kind)
            return Value(f"{as_operand(ours, rank)} {sign} {as_operand(theirs, rank + 1)}", kind, rank)
        if kind == REAL:
            raise self.refuse(node, f"{op.__name__} is for whole numbers")
        if op in (ast.FloorDiv, ast.Mod):
            width = "64" if kind == LONG else "32"
            return Value(
                f"{'floor_div' if op is ast.FloorDiv else 'floor_mod'}_{width}({left.code}, {right.code})", kind
            )
        if op is ast.LShift:
            unsigned = "uint64_t" if left.kind == LONG else "uint32_t"
            kind = LONG if left.kind == LONG else INT
            return Value(f"({kind.name})(({unsigned}){as_operand(left, 15)} << {as_operand(right, 12)})", kind, 15)
        if op is ast.RShift:
            return Value(f"{as_operand(left, 20)} >> {as_operand(right, 20)}", left.kind, 11)
        sign = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}.get(op)
        if sign is None:
            raise self.refuse(node, f"{op.__name__} is not translated")
        return Value(f"{as_operand(left, 15)} {sign} {as_operand(right, 15)}", kind, 7)

    def comparison(self, node: ast.Compare) -> Value:
        signs = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
        parts, left = [], self.value(node.left)
        for op, other in zip(node.ops, node.comparators, strict=True):
            if isinstance(op, ast.In) and isinstance(other, ast.Tuple):
                parts.append(" || ".join(f"{as_operand(left, 10)} == {self.value(one).code}" for one in other.elts))
                return Value(parts[0], BOOL, 4)
            right, sign = self.value(other), signs.get(type(op))
            if sign is None or not (isinstance(left.kind, Number) and isinstance(right.kind, Number)):
                raise self.refuse(node, "only numbers are compared, by < <= > >= == != and in")
            kind = common(left.kind, right.kind)
            ours, theirs = converted(left, kind), converted(right, kind)
            parts.append(f"{as_operand(ours, 10)} {sign} {as_operand(theirs, 10)}")
            left = right
        return Value(" && ".join(parts), BOOL, 9 if len(parts) == 1 else 5)

    def choice(self, test: Value, body: Value, orelse: Value) -> Value:
        if isinstance(body.kind, Number) and isinstance(orelse.kind, Number) and body.kind != orelse.kind:
            kind = common(body.kind, orelse.kind)
            body, orelse = converted(body, kind), converted(orelse, kind)
        return Value(f"{as_operand(test, 4)} ? {as_operand(body, 4)} : {as_operand(orelse, 3)}", body.kind, 3)

    def call(self, node: ast.Call) -> Value:
        if not isinstance(node.func, ast.Name):
            raise self.refuse(node, "only functions are called, by their names")
        called = self.globals.get(node.func.id, BUILTINS.get(node.func.id))
        if isinstance(called, type) and issubclass(called, Record):
            if node.args or node.keywords:
                raise self.refuse(node, "a new record has no values")
            self.all.need_record(called)
            return Value(called.__name__, Struct(called), NEW)
        if called in BUILTINS.values() or called in (math.sqrt, arithmetic.floor):
            return self.builtin(node, called, [self.value(argument) for argument in node.args])
        if not isinstance(called, FunctionType):
            raise self.refuse(node, f"{node.func.id} is no function that can be translated")
        name = self.all.need(called)
        if name in self.variables:
            raise self.refuse(node, f"a variable of this function is called {name} as well")
        parameters, returned = self.all.signature(called)
        given: dict[str, ast.expr] = dict(zip((name for name, _ in parameters), node.args, strict=False))
        given |= {keyword.arg: keyword.value for keyword in node.keywords if keyword.arg}
        defaults = {name: one.default for name, one in inspect.signature(called).parameters.items()}
        listed = []
        for parameter, kind in parameters:
            value = self.value(given[parameter]) if parameter in given else literal(defaults[parameter])
            if isinstance(kind, Struct):
                listed.append(self.reference(value))
            else:
                listed.append(converted(value, kind).code)
        return Value(f"{name}({', '.join(listed)})", returned or Results("void", ()))

    def builtin(self, node: ast.Call, called: Any, values: list[Value]) -> Value:  # noqa: ANN401
        kinds = [value.kind for value in values]
        if not all(isinstance(kind, Number) for kind in kinds):
            raise self.refuse(node, "it is for numbers only")
        [first, *others] = values
        if called in (min, max):
            for other in others:
                kind = common(first.kind, other.kind)  # type: ignore[arg-type]
                ours, theirs = converted(first, kind), converted(other, kind)
                first = Value(f"{called.__name__}_{SUFFIX[kind]}({ours.code}, {theirs.code})", kind)
            return first
        if called is abs:
            return Value(f"abs_{SUFFIX[first.kind]}({first.code})", first.kind)  # type: ignore[index]
        if called is math.sqrt:
            return Value(f"SQRT({converted(first, REAL).code})", REAL)
        if called is arithmetic.floor:
            return Value(f"floor_real({converted(first, REAL).code})", LONG)
        if called is float:
            return converted(first, REAL)
        if called is bool:
            return Value(f"{as_operand(first, 10)} != 0", BOOL, 9)
        if first.kind == REAL:
            return Value(f"truncated({first.code})", LONG)
        return first if first.kind in (INT, LONG) else Value(f"(int32_t){as_operand(first, 15)}", INT, 15)


NEW: Final = 21
"""Rank of a new record."""
BUILTINS: Final[dict[str, Any]] = {"abs": abs, "min": min, "max": max, "int": int, "float": float, "bool": bool}
SUFFIX: Final = {REAL: "real", LONG: "64", INT: "32", BYTE: "32", BOOL: "32"}


def evaluated(node: ast.expr, names: dict[str, Any]) -> Any:  # noqa: ANN401
    """What an annotation, or an expression of constants, is."""
    return eval(ast.unparse(node), names)  # noqa: S307 - our own source


def common(one: Number, other: Number) -> Number:
    """The type of a result of arithmetic with two numbers."""
    if REAL in (one, other):
        return REAL
    return LONG if LONG in (one, other) else INT


def literal(number: float) -> Value:
    """A number as C writes it."""
    if isinstance(number, bool):
        return Value("true" if number else "false", BOOL)
    if isinstance(number, int):
        kind = INT if -(2**31) <= number < 2**31 else LONG
        code = str(number) if kind == INT else f"INT64_C({number})"
        return Value(code, kind, 20 if number >= 0 else 15)
    return Value(f"REAL({number!r})", REAL)


class Scopes:
    """Where the variables of a function are declared: in each block that assigns them before it uses them."""

    def __init__(self, statements: Sequence[ast.stmt], parameters: Sequence[str]) -> None:
        block = list(_uses(statements))
        names = {one.id for one in _flat(block)} - set(parameters)
        self.first: set[int] = set()
        """Places at which variables are declared, by the identity of their nodes."""
        self.hoisted: set[str] = set()
        """Variables that are declared at the beginning of the function."""
        for name in names:
            found: set[int] = set()
            if self._declare(name, block, found):
                self.first |= found
            else:
                self.hoisted.add(name)

    def _declare(self, name: str, block: list[Any], found: set[int]) -> bool:
        """Find where a variable is declared in a block; False where it is used before it is assigned there."""
        direct = [one for one in block if isinstance(one, ast.Name) and one.id == name]
        inner = [one for one in block if isinstance(one, list) and any(use.id == name for use in _flat(one))]
        if not direct:
            return all(self._declare(name, one, found) for one in inner)
        first = next(one for one in block if one in direct or one in inner)
        found.add(id(first))
        return first in direct and isinstance(first.ctx, ast.Store)


def _uses(statements: Sequence[ast.stmt]) -> Iterator[Any]:
    """Names in the order in which a block uses them; those of blocks in it as lists."""
    for node in statements:
        match node:
            case ast.If() | ast.While():
                yield from _names(node.test)
                yield list(_uses(node.body))
                yield list(_uses(node.orelse))
            case ast.For():
                yield from _names(node.iter)
                yield [*_names(node.target), *_uses(node.body)]
            case ast.AugAssign():
                yield from _names(node.value)
                yield from (ast.Name(name.id, ast.Load()) for name in _names(node.target))
            case ast.Assign():
                yield from _names(node.value)
                for target in node.targets:
                    yield from _names(target)
            case ast.AnnAssign():
                yield from _names(node.value or node.target)
                yield from _names(node.target)
            case _:
                yield from _names(node)


def _names(node: ast.AST) -> list[ast.Name]:
    return [one for one in ast.walk(node) if isinstance(one, ast.Name)]


def _flat(block: list[Any]) -> Iterator[ast.Name]:
    for one in block:
        if isinstance(one, list):
            yield from _flat(one)
        else:
            yield one


# The files


HELPERS: Final = """\
#ifdef SKYLESS_SOURCE_DIGEST
SKYLESS_EXPORT extern const char *const skyless_source_digest;
const char *const skyless_source_digest = SKYLESS_SOURCE_DIGEST;
#endif

#ifdef SKYLESS_FLOAT
#define SQRT(x) __builtin_sqrtf(x)
#define FABS(x) __builtin_fabsf(x)
#else
#define SQRT(x) __builtin_sqrt(x)
#define FABS(x) __builtin_fabs(x)
#endif

static inline real min_real(real one, real other) { return other < one ? other : one; }
static inline real max_real(real one, real other) { return other > one ? other : one; }
static inline int32_t min_32(int32_t one, int32_t other) { return other < one ? other : one; }
static inline int32_t max_32(int32_t one, int32_t other) { return other > one ? other : one; }
static inline int64_t min_64(int64_t one, int64_t other) { return other < one ? other : one; }
static inline int64_t max_64(int64_t one, int64_t other) { return other > one ? other : one; }
static inline real abs_real(real x) { return FABS(x); }
static inline int32_t abs_32(int32_t x) { return x < 0 ? -x : x; }
static inline int64_t abs_64(int64_t x) { return x < 0 ? -x : x; }
static inline int64_t truncated(real x) { return REAL(-9e18) < x && x < REAL(9e18) ? (int64_t)x : 0; }
static inline int64_t floor_real(real x) { const int64_t t = truncated(x); return t - (x < (real)t && t != 0); }
static inline int32_t floor_div_32(int32_t x, int32_t y) { return x / y - (x % y != 0 && (x < 0) != (y < 0)); }
static inline int64_t floor_div_64(int64_t x, int64_t y) { return x / y - (x % y != 0 && (x < 0) != (y < 0)); }
static inline int32_t floor_mod_32(int32_t x, int32_t y) { return x - y * floor_div_32(x, y); }
static inline int64_t floor_mod_64(int64_t x, int64_t y) { return x - y * floor_div_64(x, y); }
"""


def translate(roots: Sequence[Callable[..., Any]], name: str) -> tuple[str, str]:
    """The header and the source of these functions and all that they need; ``name`` is that of the header's file.

    Raises:
        Refused: something cannot be translated.
    """
    translator = Translator(roots)
    functions = in_order(list(translator.functions.values()))
    inner = [function for function in functions if function.__name__ not in translator.roots]
    outer = [function for function in functions if function.__name__ in translator.roots]
    modules = sorted({function.__module__ for function in functions})
    head = [
        "/* Made by tools/python_to_c.py from the modules below; do not edit.", "",
        *(f"   {module}" for module in modules), "*/",
    ]  # fmt: skip
    records = [line for made in translator.records.values() for line in record_lines(made)]
    header = [
        *head, "", f"#ifndef {name.upper()}_H", f"#define {name.upper()}_H", "", "#include <stdbool.h>", "#include <stdint.h>",
        "", "#ifdef SKYLESS_FLOAT", "typedef float real;", "#define REAL(x) x##f", "#else", "typedef double real;",
        "#define REAL(x) x", "#endif", "", "#ifndef SKYLESS_EXPORT", '#define SKYLESS_EXPORT __attribute__((visibility("default")))',
        "#endif", "", *constant_lines(translator.constants), "", *records,
        *(line for function in outer for line in wrapped(f"{translator.head(function)};")), "", "#endif",
    ]  # fmt: skip
    source = [
        *head, "", f'#include "{name}.h"', "", "#ifndef INTERNAL", "#define INTERNAL static", "#endif", "", *HELPERS.splitlines(), "",
        *result_lines(translator.results),
        *(line for function in inner for line in wrapped(f"{translator.head(function)};")),
    ]  # fmt: skip
    before: FunctionType | None = None
    for function in functions:
        source += ["", *function_lines(translator, function, before)]
        before = function
    return "\n".join(header) + "\n", "\n".join(source) + "\n"


def in_order(functions: list[FunctionType]) -> list[FunctionType]:
    """Functions in the order of their modules, those that are imported first, and of their lines."""
    wanted, ordered = {function.__module__ for function in functions}, []

    def visit(name: str) -> None:
        if name not in ordered:
            module = sys.modules[name]
            for node in ast.parse(inspect.getsource(module)).body:
                if isinstance(node, ast.ImportFrom) and node.module in wanted:
                    visit(node.module)
            ordered.append(name)

    for name in sorted(wanted):
        visit(name)
    return sorted(functions, key=lambda one: (ordered.index(one.__module__), one.__code__.co_firstlineno))


def constant_lines(constants: dict[str, tuple[Any, str]]) -> list[str]:
    lines = []
    for name, (constant, doc) in sorted(constants.items()):
        value = literal(constant)
        lines += [
            *(comment(doc) if doc else []),
            f"#define {name} {value.code if value.rank == 20 else f'({value.code})'}",
        ]
    return lines


def result_lines(results: dict[str, Results]) -> list[str]:
    lines = []
    for name, found in results.items():
        items = " ".join(f"{kind.name} item_{number};" for number, kind in enumerate(found.items))
        lines += [f"typedef struct {{ {items} }} {name}_results;"]
    return [*lines, ""] if lines else []


def record_lines(made: type[Record]) -> list[str]:
    """The structure of a record."""
    node = source_of(sys.modules[made.__module__]).nodes[made.__name__]
    docs = {}
    for field, behind in zip(node.body, node.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            docs[field.target.id] = doc_of(behind)
    doc = doc_of(node.body[0])
    lines = [*(comment(doc) if doc else []), f"typedef struct {made.__name__} {{"]
    for name, ctype in made._fields_:  # type: ignore[misc]
        kind, lengths = type_of(ctype), ""
        while isinstance(kind, Elements):
            kind, lengths = kind.element, f"{lengths}[{kind.length}]"
        base = kind.name if isinstance(kind, Number) else kind.made.__name__  # type: ignore[union-attr]
        line = f"{INDENT}{base} {c_name(name)}{lengths};"
        text = docs.get(name, "")
        if text and "\n" not in text and len(line) + len(text) + 8 <= WIDTH:
            lines += [f"{line}  /* {text} */"]
        else:
            lines += [*(comment(text, INDENT) if text else []), line]
    return [*lines, f"}} {made.__name__};", ""]


def function_lines(translator: Translator, function: FunctionType, before: FunctionType | None) -> list[str]:
    """A function with what stands before it."""
    source = source_of(sys.modules[function.__module__])
    node = source.nodes[function.__name__]
    lines = []
    if before is None or before.__module__ != function.__module__:
        module_doc = inspect.getdoc(source.module) or ""
        lines += [*comment(module_doc), ""]
    begin = 0
    if before is not None and before.__module__ == function.__module__:
        begin = source.nodes[before.__name__].end_lineno or 0
    headings = [source.comments[line][1] for line in range(begin + 1, node.lineno)
                if line in source.comments and source.comments[line][0] and is_heading(source, line)]  # fmt: skip
    if headings:
        lines += [*comment(headings[-1]), ""]
    doc = doc_of(node.body[0])
    lines += comment(doc) if doc else []
    return [*lines, *wrapped(f"{translator.head(function)} {{"), *translator.bodies[c_name(function.__name__)], "}"]


def is_heading(source: Source, line: int) -> bool:
    """Whether a comment stands by itself between functions."""
    return not any(node.lineno <= line <= (node.end_lineno or 0) for node in source.nodes.values())
