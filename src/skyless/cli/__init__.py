"""The command line: one program, ``skyless``, with a module for each command."""
