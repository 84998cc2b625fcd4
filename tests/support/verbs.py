"""The command line, in the process of the tests."""

from __future__ import annotations

import pytest

from cuspid import cli


def run(*arguments: object) -> None:
    cli.main([str(argument) for argument in arguments])


def refused(capsys: pytest.CaptureFixture[str], *arguments: object, alone: bool = False) -> str:
    """The one line that a refused command prints, where ``alone`` nothing else; its exit status must be 1."""
    with pytest.raises(SystemExit) as caught:
        run(*arguments)
    assert caught.value.code == 1
    printed = [line for line in capsys.readouterr().err.splitlines() if line]
    lines = [line for line in printed if line.startswith("cuspid: ")]
    assert len(lines) == 1, printed
    assert not alone or printed == lines
    assert not any("Traceback" in line for line in printed)
    return lines[0]
