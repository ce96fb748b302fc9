"""The header and the source of a number of functions."""

import ast
import inspect
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from types import FunctionType
from typing import Any, Final

from skyless.core.native.records import Record
from translator.body import Constant, Translator
from translator.sources import INDENT, WIDTH, Source, c_name, comment, doc_of, source_of, wrapped
from translator.types import Elements, Number, Results, Type, literal

HEADER: Final = """\
#include <stdbool.h>
#include <stdint.h>

#ifdef SKYLESS_FLOAT
typedef float real;
#define REAL(x) x##f
#else
typedef double real;
#define REAL(x) x
#endif

#ifndef SKYLESS_EXPORT
#define SKYLESS_EXPORT __attribute__((visibility("default")))
#endif
"""

HELPERS: Final = """\
#ifndef INTERNAL
#define INTERNAL static
#endif

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
#ifdef SKYLESS_FLOAT
/* By two exact halves: a Cortex-M4F has no instruction for 64 bits, and its compiler's function uses double. */
static inline int64_t whole_of(real x) {
    const int32_t high = (int32_t)(x * (1 / REAL(4294967296.0)));
    const real low = x - (real)high * REAL(4294967296.0);
    return high * INT64_C(4294967296) + (low < 0 ? -(int64_t)(uint32_t)-low : (int64_t)(uint32_t)low);
}
#else
static inline int64_t whole_of(real x) { return (int64_t)x; }
#endif
static inline int64_t truncated(real x) { return REAL(-9e18) < x && x < REAL(9e18) ? whole_of(x) : 0; }
static inline int64_t floor_real(real x) {
    const int64_t found = truncated(x);
    return x > REAL(-9e18) && x < (real)found ? found - 1 : found;
}
static inline int32_t floor_div_32(int32_t x, int32_t y) { return x / y - (x % y != 0 && (x < 0) != (y < 0)); }
static inline int64_t floor_div_64(int64_t x, int64_t y) { return x / y - (x % y != 0 && (x < 0) != (y < 0)); }
static inline int32_t floor_mod_32(int32_t x, int32_t y) { return x - y * floor_div_32(x, y); }
static inline int64_t floor_mod_64(int64_t x, int64_t y) { return x - y * floor_div_64(x, y); }
"""


def translate(
    roots: Sequence[Callable[..., Any]], name: str, by_hand: Sequence[Callable[..., Any]] = ()
) -> tuple[str, str]:
    """The header and the source of these functions and all that they need; ``name`` is that of the header's file.

    Those ``by_hand`` are left out where ``SKYLESS_BY_HAND`` names a file of C that has them.

    Raises:
        RefusedError: something cannot be translated.
    """
    translator = Translator(roots)
    functions = in_order(list(translator.functions.values()))
    inner = [function for function in functions if function.__name__ not in translator.roots]
    outer = [function for function in functions if function.__name__ in translator.roots]
    modules = sorted({function.__module__ for function in functions})
    head = [
        "/* Made by tools/make_core.py from these modules; do not edit.",
        "",
        *(f" * {one}" for one in modules),
        " */",
        "",
    ]
    header = [*head, f"#ifndef {name.upper()}_H", f"#define {name.upper()}_H", "", *HEADER.splitlines(), ""]
    header += [*constant_lines(translator.constants), ""]
    header += [line for made in translator.records.values() for line in record_lines(made, translator.fields_of(made))]
    header += [line for function in outer for line in wrapped(f"{translator.head(function)};")]
    header += ["", "#endif"]
    included = ["#include <math.h>", ""] if translator.uses_libm else []
    source = [
        *head,
        f'#include "{name}.h"',
        "",
        *included,
        *HELPERS.splitlines(),
        "",
        *result_lines(translator.results),
    ]
    source += [line for function in inner for line in wrapped(f"{translator.head(function)};")]
    before: FunctionType | None = None
    for function in functions:
        lines = function_lines(translator, function, before)
        source += ["", *(["#ifndef SKYLESS_BY_HAND", *lines, "#endif"] if function in by_hand else lines)]
        before = function
    source += ["", "#ifdef SKYLESS_BY_HAND", "#include SKYLESS_BY_HAND", "#endif"] if by_hand else []
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


def constant_lines(constants: dict[str, Constant]) -> list[str]:
    lines = []
    for name, one in sorted(constants.items()):
        value = literal(one.value)
        code = f"({one.code})" if one.code else value.code if value.rank == 20 else f"({value.code})"
        lines += comment(one.doc) if one.doc else []
        defined = [f"#define {name} {code}"]
        lines += [f"#ifndef {name}", *defined, "#endif"] if one.is_size else defined
    return lines


def result_lines(results: dict[str, Results]) -> list[str]:
    lines = []
    for name, found in results.items():
        items = " ".join(f"{kind.name} item_{number};" for number, kind in enumerate(found.items))
        lines += [f"typedef struct {{ {items} }} {name}_results;"]
    return [*lines, ""] if lines else []


def record_lines(made: type[Record], fields: dict[str, Type]) -> list[str]:
    """The structure of a record."""
    node = source_of(sys.modules[made.__module__]).nodes[made.__name__]
    docs = {}
    for declaration, behind in pairwise(node.body):
        if isinstance(declaration, ast.AnnAssign) and isinstance(declaration.target, ast.Name):
            docs[declaration.target.id] = doc_of(behind)
    doc = doc_of(node.body[0])
    lines = [*(comment(doc) if doc else []), f"typedef struct {made.__name__} {{"]
    for name, field in fields.items():
        kind, lengths = field, ""
        while isinstance(kind, Elements):
            lengths, kind = f"{lengths}[{kind.length}]", kind.element
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
