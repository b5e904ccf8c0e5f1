"""Run the conformance kits of a module."""

from unittest import SkipTest


def checks_of(kit):
    """Return the names of the checks of a kit."""
    return [name for name in dir(kit) if name.startswith("test_")]


def run_kits(module, **attributes):
    """Run each check of the classes Test… among the names of a module, with attributes of theirs replaced."""
    kits = [value for name, value in module.items() if name.startswith("Test")]
    assert kits
    for kit in kits:
        own = type(
            kit.__name__, (kit,), {key: value for key, value in attributes.items() if hasattr(kit, key)}
        )
        for name in checks_of(kit):
            try:
                getattr(own(), name)()
            except SkipTest:
                continue
