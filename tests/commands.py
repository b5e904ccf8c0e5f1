"""Commands run in the process of the tests."""

from flexneedle.cli import main as cli


def run(capsys, *argv):
    """Return exit status, stdout and stderr."""
    status = cli.main(argv)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def names(folder):
    return sorted(path.name for path in folder.iterdir())
