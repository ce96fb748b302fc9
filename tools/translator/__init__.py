"""Translate functions over records (``skyless.core.native.records``) from Python to C, with the same bits.

What it takes: functions whose parameters and result have types; numbers, records, and their arrays of fixed length.

    types        int (32 bits), Ticks and Count (64 bits), Byte, bool, float (C's ``real``), records (by reference),
                 ``Array[Record]``, ``Reals``, ``Integers``, ``Bytes``, ``Annotated[Matrix, N, M]``;
                 as a result also ``tuple`` of numbers
    statements   assignments, also several at once, with an operator or with a type; ``if``, ``while``,
                 ``for … in range(…)``, ``break``, ``continue``, ``return``, ``pass``, calls
    expressions  arithmetic, comparisons, ``in (A, B)``, ``not in``, ``and``, ``or``, ``not``, ``x if c else y``,
                 attributes, subscripts, calls of other such functions and of ``abs``, ``min``, ``max``, ``int``,
                 ``float``, ``bool``, ``floor``, ``sqrt``, and where bits may depend on the machine of ``math``'s
                 ``exp``, ``log``, ``sin`` and others (``body.LIBM``); constants of modules; ``Record()`` as the value
                 of a new variable, which in a loop is the same memory each time

All else is refused with file, line and reason; so are a call of what may write fields beside what reads them, which C
evaluates in any order, and a loop's variable that is assigned in it or used after it. ``//`` and ``%`` round down as in
Python; ``min`` and ``max`` give the first of equals; a bound of a range is looked up once. A variable keeps the type of
its first value; what is an element of an array or a field of a record, and no number, is a reference, as in Python.
Whole numbers are assumed to fit, and divisors not to be zero. Docstrings and comments come along.

``make_core.py`` makes the files of ``skyless.core.native`` with it (``translator.files``).
"""
