"""The command line in this process, and the files it writes."""

from pimper_torch.cli.main import main


def run(*arguments):
    """Run a command; return its exit code."""
    return main([str(argument) for argument in arguments])


def contents(folder):
    """Return the bytes of all files with a suffix."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.*")}
