"""Kernels in the interpreter, for tests that call them one by one: compiling them would take longer."""

from types import FunctionType, SimpleNamespace


def interpreted(*modules):
    """Return the kernels of some modules as plain functions."""
    names = {name: value for module in modules for name, value in vars(module).items()}
    for name, value in list(names.items()):
        if hasattr(value, "py_func"):
            names[name] = FunctionType(value.py_func.__code__, names, name)
    return SimpleNamespace(**names)


class Record:
    """A record whose fields are attributes, as in a compiled kernel."""

    def __init__(self, record):
        object.__setattr__(self, "record", record)

    def __getattr__(self, name):
        return self.record[name]

    def __setattr__(self, name, value):
        self.record[name] = value
