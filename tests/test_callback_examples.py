"""Every public callback shows how it is used, and the example does what it says."""

import doctest
from pathlib import Path

import pytest

from sb3_quad import callbacks


@pytest.mark.parametrize("name", callbacks.__all__)
def test_the_example_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    callback = getattr(callbacks, name)
    (test,) = doctest.DocTestFinder(recurse=False).find(
        callback, name, globs={name: callback, "Path": Path}
    )
    assert any("model.learn(" in example.source for example in test.examples)
    report: list[str] = []
    doctest.DocTestRunner().run(test, out=report.append)
    assert not report, "".join(report)
