"""Docstrings of fields are read from source, and `help` shows them."""

import dataclasses
import pydoc

import pytest

import warpgs
from warpgs.errors import document_fields, field_docs

DOCUMENTED = ("ActivatedGaussians", "Camera", "CovarianceGaussians", "Gaussians", "RasterizeOptions", "Render", "Scene", "View")


@pytest.mark.parametrize("name", DOCUMENTED)
def test_help_shows_every_field(name):
    """With the start of its docstring."""
    kind = getattr(warpgs, name)
    shown = pydoc.plain(pydoc.render_doc(kind))
    for field in dataclasses.fields(kind):
        assert f"{field.name}: {field_docs(kind)[field.name].split()[0]} " in shown


@dataclasses.dataclass
class Same:
    """A class whose name is used twice in this file."""

    outer: int
    """Field of the outer class."""

    @dataclasses.dataclass
    class Same:
        """The inner class."""

        inner: int
        """Field of the inner class."""


def test_classes_of_one_name_keep_their_own_fields():
    """Nested in a class, in a function, derived, or without source."""

    @dataclasses.dataclass
    class Local(Same):
        """A class of a function."""

        local: int
        """Field of the local class."""

    assert field_docs(Same) == {"outer": "Field of the outer class."}
    assert field_docs(Same.Same) == {"inner": "Field of the inner class."}
    assert field_docs(Local) == {"outer": "Field of the outer class.", "local": "Field of the local class."}
    typed = dataclasses.make_dataclass("Typed", ["x"], namespace={"__doc__": "About."})
    assert field_docs(typed) == {} and document_fields(typed).__doc__.startswith("About.")
