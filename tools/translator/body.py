"""Statements and expressions of a function."""

import ast
import inspect
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from types import FunctionType, ModuleType
from typing import Any, Final, NamedTuple, get_type_hints

from skyless.core.native import arithmetic, records
from skyless.core.native.records import Record, has_defaults
from translator.capacities import expression, follows, home_of, names_in
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

LIBM: Final = {
    getattr(math, name): name for name in ("atan2", "cos", "erfc", "exp", "expm1", "hypot", "log", "log10", "sin")
}
"""Functions of C's library, whose last bits depend on it."""

BUILTINS: Final[dict[str, Any]] = {"abs": abs, "min": min, "max": max, "int": int, "float": float, "bool": bool}
SUFFIX: Final = {REAL: "real", LONG: "64", INT: "32", BYTE: "32", BOOL: "32"}


class RefusedError(Exception):
    """A place that cannot be translated."""


class Constant(NamedTuple):
    """A constant of some modules."""

    value: Any
    code: str
    """Where it follows from sizes."""
    doc: str
    is_size: bool


class Translator:
    """All that is translated, as far as it is known that it is needed."""

    def __init__(self, roots: Sequence[Callable[..., Any]]) -> None:
        self.roots = {root.__name__ for root in roots}
        self.functions: dict[str, FunctionType] = {}
        self.records: dict[str, type[Record]] = {}
        self.constants: dict[str, Constant] = {}
        self.fields: dict[type[Record], dict[str, Type]] = {}
        self.bodies: dict[str, list[str]] = {}
        self.results: dict[str, Results] = {}
        self.uses_libm = False
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
            for field in self.fields_of(made).values():
                kind = field
                while isinstance(kind, Elements):
                    kind = kind.element
                if isinstance(kind, Struct):
                    self.need_record(kind.made)
            self.records[made.__name__] = made

    def fields_of(self, made: type[Record]) -> dict[str, Type]:
        """The types of a record's fields."""
        if made not in self.fields:
            module = sys.modules[made.__module__]
            nodes = {node.target.id: node.annotation for node in source_of(module).nodes[made.__name__].body
                     if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)}  # fmt: skip
            self.fields[made] = {name: type_of(ctype, self.lengths(module, nodes[name]))
                                 for name, ctype, *_ in made._fields_}  # fmt: skip
        return self.fields[made]

    def lengths(self, module: ModuleType, annotation: ast.expr | None) -> list[str]:
        """The lengths of an array's annotation as C has them, empty where they are numbers."""
        match annotation:
            case ast.Subscript(value=ast.Name(id="Annotated"), slice=ast.Tuple(elts=[_, *lengths])):
                return [self.expression(module, one) for one in lengths]
        return []

    def expression(self, module: ModuleType, node: ast.expr | None) -> str:
        """An expression of a module that follows from sizes, in C; its constants are needed. Of others nothing."""
        if node is None or not follows(module, node):
            return ""
        for name in names_in(node):
            self.need_constant(module, name)
        return expression(node)

    def need_constant(self, module: ModuleType, name: str) -> Any:  # noqa: ANN401
        """The value of a constant of a module, which is needed."""
        home = home_of(module, name)
        value, source = getattr(home, name), source_of(home)
        if c_name(name) not in self.constants:
            code = self.expression(home, source.values.get(name)) if isinstance(value, int) else ""
            self.constants[c_name(name)] = Constant(value, code, source.docs.get(name, ""), home is records)
        return self.constants[c_name(name)].value

    def signature(self, function: FunctionType) -> tuple[list[tuple[str, Type]], Type | None]:
        """Names and types of parameters, and the type of the result."""
        hints = get_type_hints(function, include_extras=True)
        module = sys.modules[function.__module__]
        nodes = {one.arg: one.annotation for one in source_of(module).nodes[function.__name__].args.args}  # type: ignore[union-attr]
        place = f"{function.__code__.co_filename}:{function.__code__.co_firstlineno}"
        if hints.keys() != {*function.__code__.co_varnames[: function.__code__.co_argcount], "return"}:
            raise RefusedError(f"{place}: each parameter and the result of {function.__name__} need a type")
        returned = hints.pop("return")
        try:
            parameters = [
                (name, parameter_type(hint, self.lengths(module, nodes[name]))) for name, hint in hints.items()
            ]
            result = None if returned is type(None) else parameter_type(returned)
        except (IndexError, TypeError) as error:
            raise RefusedError(f"{place}: {function.__name__}: {error}") from error
        for _, kind in parameters:
            element = kind
            while isinstance(element, Elements):
                element = element.element
            if isinstance(element, Struct):
                self.need_record(element.made)
        if isinstance(result, Elements):
            raise RefusedError(f"{place}: {function.__name__} returns an array; it can be a parameter")
        if isinstance(result, Results):
            result = self.results[c_name(function.__name__)] = Results(c_name(function.__name__), result.items)
        return parameters, result

    def written(self, node: ast.AST, names: dict[str, Any]) -> set[str]:
        """Fields that may be written by the functions that are called in a statement or expression.

        These are all that a function with an assignment to a field or an element names.
        """
        found: set[str] = set()
        for body in self.called(node, names, set()):
            parts = [one for one in ast.walk(body) if isinstance(one, ast.Attribute | ast.Subscript)]
            if any(isinstance(one.ctx, ast.Store) for one in parts):
                found |= {one.attr for one in parts if isinstance(one, ast.Attribute)} | {""}
        return found

    def called(self, node: ast.AST, names: dict[str, Any], known: set[FunctionType]) -> Iterator[ast.stmt]:
        """The bodies of functions that are called in a statement or expression, and of those that they call."""
        for one in ast.walk(node):
            function = names.get(one.func.id) if isinstance(one, ast.Call) and isinstance(one.func, ast.Name) else None
            if isinstance(function, FunctionType) and function not in known:
                known.add(function)
                body = source_of(inspect.getmodule(function)).nodes[function.__name__]  # type: ignore[arg-type]
                yield body
                yield from self.called(body, function.__globals__, known)

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

    def check_order(self, node: ast.AST, *operands: ast.expr) -> None:
        """Refuse operands of which one may write what another one reads: C evaluates them in any order."""
        for one in operands:
            written = self.all.written(one, self.globals)
            if any(self.read(other) & written for other in operands if other is not one):
                raise self.refuse(node, "a function is called that may write what is read beside it")

    def read(self, node: ast.expr) -> set[str]:
        """Fields that an expression reads, with those of functions that it calls; "" for elements of any of them."""
        found: set[str] = set()
        for body in self.all.called(node, self.globals, set()):
            found |= {one.attr for one in ast.walk(body) if isinstance(one, ast.Attribute)}
        for one in ast.walk(node):
            if isinstance(one, ast.Attribute | ast.Subscript) and isinstance(self.value(one).kind, Number):
                while isinstance(one, ast.Subscript):
                    one = one.value  # noqa: PLW2901
                found.add(one.attr if isinstance(one, ast.Attribute) else "")
        return found

    def once(self, node: ast.expr) -> None:
        """Refuse an expression that C evaluates more often than Python if that makes a difference."""
        if self.all.written(node, self.globals):
            raise self.refuse(node, "a function that may write is called where C calls it more than once")

    def fitting(self, node: ast.AST, value: Value, kind: Type) -> Value:
        """The value as a number of a type that keeps it."""
        is_whole = isinstance(kind, Number) and kind != REAL
        narrow = (is_whole and value.kind == REAL) or (kind == BOOL and value.kind != BOOL)
        if narrow or isinstance(kind, Number) != isinstance(value.kind, Number):
            raise self.refuse(node, f"it is {_named(value.kind)}, and {_named(kind)} is wanted")
        return converted(value, kind)

    def annotated(self, node: ast.expr) -> Type:
        """The type of an annotation."""
        try:
            return parameter_type(evaluated(node, self.globals))
        except TypeError as error:
            raise self.refuse(node, str(error)) from error

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
                kind = self.annotated(node.annotation)
                yield from self.store(node.target, self.value(value), indent, name, kind)
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
        stores = (one for part in node.body for one in ast.walk(part) if isinstance(one, ast.Name))
        if any(one.id == name and isinstance(one.ctx, ast.Store) for one in stores):
            raise self.refuse(node, f"{name} is assigned within its loop")
        if id(node.target) not in self.scopes.first and not name.startswith("time_"):
            raise self.refuse(node, f"{name} is used beside its loop")
        values = [self.value(limit) for limit in limits]
        begin, end = (Value("0", INT), values[0]) if len(values) == 1 else (values[0], values[1])
        try:
            step = evaluated(limits[2], self.globals) if len(limits) == 3 else 1
        except NameError as error:
            raise self.refuse(node, "the step of a range is a constant") from error
        kind = LONG if LONG in (begin.kind, end.kind) else INT
        self.kinds[name] = (kind, True)
        variable, limit = c_name(name), end.code
        first = f"{kind.name} {variable} = {begin.code}"
        if self.may_change(limits[0] if len(limits) == 1 else limits[1], node.body):
            limit = f"{variable}_end"
            first += f", {limit} = {end.code}"
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
            self.check_order(value, *value.elts)
            wanted = zip(value.elts, self.returned.items, strict=True)
            items = [self.fitting(item, self.value(item), kind) for item, kind in wanted]
            listed = ", ".join(item.code for item in items)
            yield f"{indent}return ({self.returned.function}_results){{{listed}}};"
        else:
            found, kind = self.value(value), self.returned
            assert kind is not None
            code = self.reference(found) if isinstance(found.kind, Struct) else self.fitting(value, found, kind).code
            yield f"{indent}return {code};"

    def assign(self, node: ast.Assign, indent: str) -> Iterator[str]:
        if len(node.targets) > 1:
            self.once(node.value)
            for target in reversed(node.targets):
                yield from self.store(target, self.value(node.value), indent)
        elif not isinstance(node.targets[0], ast.Tuple):
            self.check_order(node, node.value, *_indices(node.targets[0]))
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
        calls = any(isinstance(part, ast.Call) for value in values[1:] for part in ast.walk(value))
        is_local = all(isinstance(target, ast.Name) for target in targets) or not calls
        if is_local and not any(written[k] in names for k in range(len(targets)) for names in later[k + 1 :]):
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
                yield from self.declare(target, kind, value, indent)
                return
            known, is_pointer = self.kinds[name]
            if known == INT and value.kind == LONG:
                raise self.refuse(target, f"{name} has 32 bits and is given 64; declare it as Ticks")
            if isinstance(known, Struct) and not is_pointer:
                raise self.refuse(target, f"{name} is a record, and cannot become another")
            if isinstance(known, Struct) and value.kind != known:
                raise self.refuse(target, f"{name} is {_named(known)}, and is given {_named(value.kind)}")
            code = self.reference(value) if isinstance(known, Struct) else self.fitting(target, value, known).code
            yield f"{indent}{c_name(name)} = {code};"
            return
        place = self.value(target)
        if isinstance(place.kind, Struct):
            yield f"{indent}{self.record(place)} = {self.record(value)};"
        elif isinstance(place.kind, Elements):
            raise self.refuse(target, "an array cannot be assigned to")
        else:
            yield f"{indent}{place.code} = {self.fitting(target, value, place.kind).code};"

    def declare(self, target: ast.Name, kind: Type, value: Value, indent: str) -> Iterator[str]:
        """A new variable: where it is assigned if all blocks that use it assign it first, else at the beginning."""
        name, variable, kind = target.id, c_name(target.id), INT if kind == BYTE else kind
        if isinstance(kind, Struct) and value.rank == NEW:
            self.kinds[name] = (kind, False)
            if indent == INDENT:
                yield f"{indent}{kind.made.__name__} {variable} = {initialiser(kind.made)};"
            else:  # it lives as long as the function runs, as in Python what has a reference does
                self.hoisted.append(f"{kind.made.__name__} {variable};")
                yield f"{indent}{variable} = {self.record(value)};"
            return
        self.kinds[name] = (kind, True)
        code = self.reference(value) if isinstance(kind, Struct) else self.fitting(target, value, kind).code
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
        self.once(node.target)
        self.check_order(node, node.target, node.value)
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
        if value.rank == NEW:
            raise RefusedError(
                f"{self.source.module.__file__}:{self.last_line}: a new record needs a name: {value.code}()"
            )
        return value.code if value.is_pointer else f"&{as_operand(value, 15)}"

    def record(self, value: Value) -> str:
        """A record itself."""
        if value.rank == NEW:
            return f"({value.code}){initialiser(value.kind.made)}"  # type: ignore[union-attr]
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
                if isinstance(constant, int) and constant >= 1 << 63:
                    raise self.refuse(node, "it has more than 64 bits")
                return literal(constant)
            case ast.Name(id=name):
                return self.name(node, name)
            case ast.Attribute(value=of, attr=field):
                return self.field(node, self.value(of), field)
            case ast.Subscript(value=of, slice=index):
                array, place = self.value(of), self.value(index)
                if isinstance(index, ast.UnaryOp):
                    raise self.refuse(node, "elements are counted from the first one")
                if not isinstance(array.kind, Elements):
                    raise self.refuse(node, "only arrays have elements")
                return Value(f"{as_operand(array, 16)}[{place.code}]", array.kind.element, 16, False)
            case ast.BinOp():
                self.check_order(node, node.left, node.right)
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
        known = self.all.need_constant(self.source.module, name)
        if known != constant:
            raise self.refuse(node, f"another constant of this name is {known}")
        return literal(constant)._replace(code=c_name(name), rank=20)

    def field(self, node: ast.expr, of: Value, field: str) -> Value:
        if not isinstance(of.kind, Struct) or of.rank == NEW:
            raise self.refuse(node, "only records that have a name have fields")
        self.all.need_record(of.kind.made)
        kind = self.all.fields_of(of.kind.made).get(field)
        if kind is None:
            raise self.refuse(node, f"{of.kind.made.__name__} has no field {field}")
        return Value(f"{as_operand(of, 16)}{'->' if of.is_pointer else '.'}{c_name(field)}", kind, 16, False)

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
            return Value(f"({kind.name})(({unsigned}){as_operand(left, 15)} << {as_operand(right, 13)})", kind, 15)
        if op is ast.RShift:
            return Value(f"{as_operand(left, 20)} >> {as_operand(right, 20)}", left.kind, 11)
        bitwise = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}.get(op)
        if bitwise is None:
            raise self.refuse(node, f"{op.__name__} is not translated")
        kind = BOOL if left.kind == right.kind == BOOL else kind
        return Value(f"{as_operand(left, 15)} {bitwise} {as_operand(right, 15)}", kind, 7)

    def comparison(self, node: ast.Compare) -> Value:
        signs = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
        parts, left = [], self.value(node.left)
        self.check_order(node, node.left, *node.comparators)
        for middle in (*node.comparators[:-1], *([node.left] if isinstance(node.ops[0], ast.In | ast.NotIn) else [])):
            self.once(middle)
        for op, other in zip(node.ops, node.comparators, strict=True):
            if isinstance(op, ast.In | ast.NotIn) and isinstance(other, ast.Tuple):
                equal, word, rank = ("==", " || ", 4) if isinstance(op, ast.In) else ("!=", " && ", 5)
                each = (f"{as_operand(left, 10)} {equal} {as_operand(self.value(one), 10)}" for one in other.elts)
                return Value(word.join(each), BOOL, rank)
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
        if isinstance(body.kind, Struct):
            body, orelse = (Value(self.reference(one), one.kind, 15) for one in (body, orelse))
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
        if called in LIBM:
            values = [converted(self.value(argument), REAL).code for argument in node.args]
            self.check_order(node, *node.args)
            self.all.uses_libm = True
            return Value(f"{LIBM[called]}({', '.join(values)})", REAL)
        if called in BUILTINS.values() or called in (math.sqrt, arithmetic.floor):
            return self.builtin(node, called, [self.value(argument) for argument in node.args])
        if not isinstance(called, FunctionType):
            raise self.refuse(node, f"{node.func.id} is no function that can be translated")
        name = self.all.need(called)
        if name in self.variables:
            raise self.refuse(node, f"a variable of this function is called {name} as well")
        parameters, returned = self.all.signature(called)
        if len(node.args) > len(parameters):
            raise self.refuse(node, f"{name} has {len(parameters)} parameters")
        self.check_order(node, *node.args, *(keyword.value for keyword in node.keywords))
        given: dict[str, ast.expr] = dict(zip((name for name, _ in parameters), node.args, strict=False))
        given |= {keyword.arg: keyword.value for keyword in node.keywords if keyword.arg}
        defaults = {name: one.default for name, one in inspect.signature(called).parameters.items()}
        listed = []
        for parameter, kind in parameters:
            if parameter not in given and defaults[parameter] is inspect.Parameter.empty:
                raise self.refuse(node, f"it has no value for {parameter}")
            value = self.value(given[parameter]) if parameter in given else literal(defaults[parameter])
            if isinstance(kind, Struct):
                listed.append(self.reference(value))
            else:
                listed.append(self.fitting(node, value, kind).code)
        return Value(f"{name}({', '.join(listed)})", returned or Results("void", ()))

    def builtin(self, node: ast.Call, called: Any, values: list[Value]) -> Value:  # noqa: ANN401, PLR0911
        kinds = [value.kind for value in values]
        if not all(isinstance(kind, Number) for kind in kinds):
            raise self.refuse(node, "it is for numbers only")
        if (len(values) < 2) if called in (min, max) else (len(values) != 1):
            raise self.refuse(node, f"{called.__name__} has another number of arguments")
        self.check_order(node, *node.args)
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


def initialiser(made: type[Record]) -> str:
    """What a new record begins with: its defaults, and zeros."""
    parts = []
    for name, ctype in made._fields_:  # type: ignore[misc]
        if name in made._defaults_:
            value = made._defaults_[name]
            parts.append(f".{c_name(name)} = {literal(float(value) if type_of(ctype) == REAL else value).code}")
        elif has_defaults(ctype):
            parts.append(f".{c_name(name)} = {initialiser(ctype)}")  # type: ignore[arg-type]
    return f"{{{', '.join(parts) or 0}}}"


def _indices(target: ast.expr) -> list[ast.expr]:
    """The indices of an element that is assigned."""
    return [one.slice for one in ast.walk(target) if isinstance(one, ast.Subscript)]


def _named(kind: Type) -> str:
    """A type, for messages."""
    return kind.name if isinstance(kind, Number) else kind.made.__name__ if isinstance(kind, Struct) else "an array"


def evaluated(node: ast.expr, names: dict[str, Any]) -> Any:  # noqa: ANN401
    """What an annotation, or an expression of constants, is."""
    return eval(ast.unparse(node), names)
