"""Statements and expressions of a function."""

import ast
import inspect
import math
from collections.abc import Callable, Iterator, Sequence
from types import FunctionType
from typing import Any, Final, get_type_hints

from skyless.core.native import arithmetic
from skyless.core.native.records import Record
from translator.scopes import Scopes, assigned
from translator.sources import INDENT, c_name, comment, doc_of, source_of, wrapped
from translator.types import (
    BOOL,
    BYTE,
    INT,
    LONG,
    NEW,
    REAL,
    Elements,
    Number,
    Results,
    Struct,
    Type,
    Value,
    as_operand,
    common,
    converted,
    declared,
    literal,
    parameter_type,
    type_of,
)

BUILTINS: Final[dict[str, Any]] = {"abs": abs, "min": min, "max": max, "int": int, "float": float, "bool": bool}
SUFFIX: Final = {REAL: "real", LONG: "64", INT: "32", BYTE: "32", BOOL: "32"}


class RefusedError(Exception):
    """A place that cannot be translated."""


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
            raise RefusedError(f"two functions are called {name}: in {known.__module__} and {function.__module__}")
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
        self.variables = {c_name(name) for name in assigned(statements)}
        self.last_line = statements[0].lineno - 1
        self.temporaries = 0
        self.hoisted: list[str] = []
        body = list(self.block(statements, INDENT))
        self.lines = [*(f"{INDENT}{one}" for one in self.hoisted), *body]

    def refuse(self, node: ast.AST, reason: str) -> RefusedError:
        """The error for a place."""
        line = getattr(node, "lineno", 0)
        return RefusedError(f"{self.source.module.__file__}:{line}: {reason}: {ast.unparse(node)[:80]}")

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

    def statement(self, node: ast.stmt, indent: str) -> Iterator[str]:
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
            found, kind = self.value(value), self.returned
            assert kind is not None
            code = self.reference(found) if isinstance(found.kind, Struct) else converted(found, kind).code
            yield f"{indent}return {code};"

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
        for one in map(self.value, values):
            self.temporaries += 1
            name = f"new_{self.temporaries}"
            yield f"{indent}const {declared(one.kind, name)} = {one.code};"
            found.append(one._replace(code=name, rank=20))
        for target, one in zip(targets, found, strict=True):
            yield from self.store(target, one, indent)

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
        is_real = REAL in (place.kind, value.kind) or plain == "/"
        fits = isinstance(place.kind, Number) and (place.kind == REAL or not is_real)
        if plain and fits and (place.kind != INT or value.kind != LONG):
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

    def value(self, node: ast.expr) -> Value:  # noqa: PLR0911, PLR0912 - one for each kind
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
                word, rank = (" && ", 5) if isinstance(op, ast.And) else (" || ", 4)
                return Value(word.join(as_operand(self.condition(part), 6) for part in parts), BOOL, rank)
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
        known, _ = self.all.constants.setdefault(c_name(name), (constant, self.source.docs.get(name, "")))
        if known != constant:
            raise self.refuse(node, f"another constant of this name is {known}")
        return literal(constant)._replace(code=c_name(name), rank=20)

    def field(self, node: ast.expr, of: Value, field: str) -> Value:
        if not isinstance(of.kind, Struct):
            raise self.refuse(node, "only records have fields")
        self.all.need_record(of.kind.made)
        ctype = {one[0]: one[1] for one in of.kind.made._fields_}.get(field)
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
        bitwise = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}.get(op)
        if bitwise is None:
            raise self.refuse(node, f"{op.__name__} is not translated")
        return Value(f"{as_operand(left, 15)} {bitwise} {as_operand(right, 15)}", kind, 7)

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

    def builtin(self, node: ast.Call, called: Any, values: list[Value]) -> Value:  # noqa: ANN401, PLR0911
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


def evaluated(node: ast.expr, names: dict[str, Any]) -> Any:  # noqa: ANN401
    """What an annotation, or an expression of constants, is."""
    return eval(ast.unparse(node), names)
