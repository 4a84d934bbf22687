"""However a process ends, one message gives the cause, and no process is left running."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from scenes import ball

from pimper_torch.cli import supervise
from pimper_torch.cli.options import bundled_photographs
from pimper_torch.cli.stopping import stoppable
from pimper_torch.io.meshes import write_ply

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="one process alone")

# The command line with `config` replaced by the code of a test.
PROGRAM = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever started this may ignore it
from pimper_torch.cli import main
main._COMMANDS = {"config": "stand_in", "reconstruct": "stand_in"}
main._LIGHT = ("config", "reconstruct")
from pimper_torch.cli.supervise import main as supervised
sys.exit(supervised())
"""
READY = "os.write(int(os.environ['READY']), b'ready');"


def heard() -> None:
    """Handle SIGHUP by default, also if the tests run under `nohup`."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


class Ran:
    """A run of the program that has printed that it is ready."""

    def __init__(self, folder: Path, code: str, *arguments: str):
        (folder / "stand_in.py").write_text(code)
        hears, tells = os.pipe()
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *(arguments or ("config",))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=os.environ
            | {"PYTHONPATH": os.pathsep.join([str(folder), *sys.path]), "READY": str(tells)},
            pass_fds=(tells,),
            start_new_session=True,
            preexec_fn=heard,
        )
        os.close(tells)
        os.read(hears, 5)
        os.close(hears)

    @property
    def worker(self) -> int:
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        return int(children.read_text().split()[0])

    def end(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=30)
        return self.process.returncode, out, err


def at_run(code: str) -> str:
    lines = "\n".join(f"    {line}" for line in code.strip().splitlines())
    head = "import os, sys, time, ctypes\ndef checked(command, arguments): pass"
    return f"{head}\ndef run(job, output):\n{lines}\n"


# Short sleeps: a signal just before a system call is handled only after it.
WAITS = f"{READY} [time.sleep(0.05) for _ in range(1200)]"


@pytest.mark.parametrize(
    ("code", "number", "message"),
    [
        ("os.kill(os.getpid(), 9)", 9, "killed by the system or by somebody (SIGKILL)"),
        ("ctypes.CDLL(None).abort()", 6, "crashed (SIGABRT), most likely because memory ran out"),
    ],
)
def test_the_cause_of_a_killed_run_is_one_paragraph(tmp_path, code, number, message):
    given = ["reconstruct", "photos", "-o", "out", "--json"]
    returned, out, err = Ran(tmp_path, at_run(f"{READY}\n{code}"), *given).end()
    assert returned == 128 + number
    *crash, line = err.splitlines()
    assert line.startswith("error: ")
    assert message in line
    assert "--max-size-px" in line
    assert "the same command continues" in line
    assert ("stand_in.py" in "".join(crash)) is (number != 9)  # where it crashed
    last = json.loads(out.splitlines()[-1])
    assert (last["event"], last["kind"], last["exit_code"]) == ("error", "Killed", returned)
    assert f"error: {last['message']}" == line


@pytest.mark.parametrize(
    ("number", "group", "importing"),
    [
        (signal.SIGINT, True, True),
        (signal.SIGINT, True, False),
        (signal.SIGTERM, False, False),
        (signal.SIGHUP, True, False),
    ],
)
def test_a_signal_gives_one_message(tmp_path, number, group, importing):
    """Ctrl-C reaches both processes of a terminal; `kill` only the first."""
    code = f"import os, time; {WAITS}" if importing else at_run(WAITS)
    ran = Ran(tmp_path, code, "config", "--json")
    (os.killpg if group else os.kill)(ran.process.pid, number)
    returned, out, err = ran.end()
    assert returned == 128 + number
    assert err == "error: interrupted; no result was written.\n"
    last = json.loads(out.splitlines()[-1])
    assert (last["event"], last["exit_code"]) == ("error", 128 + number)


DEAF = f"while True:\n try:\n  {WAITS}\n except BaseException: pass"
LEAVES = "from pimper_torch.runtime.scratch import scratch\nheld = scratch()\nheld.__enter__()\n"


def test_a_run_that_ignores_a_signal_is_killed_within_five_seconds(tmp_path, monkeypatch):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    ran = Ran(tmp_path, at_run(LEAVES + DEAF))
    assert any(temporary.iterdir())
    began = time.monotonic()
    ran.process.terminate()
    returned, _, err = ran.end()
    assert 4 < time.monotonic() - began < 5.5  # half a second of tolerance for a busy machine
    assert returned == 143
    assert err.startswith("error: killed, as it did not stop in time. No result was written")
    assert not any(temporary.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(("command", "after"), [("evaluate", 8), ("reconstruct", 20)])
def test_a_library_call_ends_within_five_seconds_of_a_signal(tmp_path, command, after):
    """Ten million samples keep one library call busy for longer, as feature detection may."""
    mesh, cloud, whole = tmp_path / "mesh.ply", tmp_path / "cloud.ply", ball(level=7)
    write_ply(whole, mesh)
    write_ply(whole.replace(faces=whole.faces[:0]), cloud)
    given = {
        "evaluate": [mesh, cloud, "--samples", "10000000"],
        "reconstruct": [bundled_photographs(), "-o", tmp_path / "out"],
    }
    ran = subprocess.Popen(
        [sys.executable, "-m", "pimper_torch", command, *map(str, given[command])],
        stderr=subprocess.PIPE,
        text=True,
    )
    time.sleep(after)  # in most cases inside the call
    began = time.monotonic()
    ran.terminate()
    _, err = ran.communicate(timeout=30)
    assert time.monotonic() - began < 5.5
    assert ran.returncode == 143
    assert "No result was written" in err or "no result was written" in err
    assert not (tmp_path / "out" / "mesh.ply").exists()


@pytest.mark.parametrize("late", [False, True])
def test_a_second_ctrl_c_ends_an_uninterruptible_run(tmp_path, late):
    ran = Ran(tmp_path, at_run(DEAF))
    os.killpg(ran.process.pid, signal.SIGINT)
    time.sleep(5 if late else 0.5)
    assert ran.process.poll() is None
    os.killpg(ran.process.pid, signal.SIGINT)
    returned, _, err = ran.end()
    assert returned == 130
    assert "killed, as it did not stop in time" in err
    assert ("a second Ctrl-C stops it immediately.\n" in err) is late


def test_after_a_ctrl_c_that_was_taken_up_the_next_one_counts_as_the_first(tmp_path):
    code = f"""
from pimper_torch.cli.stopping import Stopped, taken_up
try:
    {WAITS}
except Stopped:
    taken_up()
{WAITS.removeprefix(READY).strip()}
"""
    ran = Ran(tmp_path, at_run(code))
    os.killpg(ran.process.pid, signal.SIGINT)
    time.sleep(5)  # longer than the patience
    assert ran.process.poll() is None
    os.killpg(ran.process.pid, signal.SIGINT)
    assert ran.end() == (130, "", "error: interrupted; no result was written.\n")


@pytest.mark.skipif(sys.platform != "linux", reason="others look once a second")
def test_the_worker_exits_with_its_parent(tmp_path):
    ran = Ran(tmp_path, at_run(WAITS))
    worker = ran.worker
    ran.process.kill()
    ran.process.wait()
    for _ in range(100):
        if not Path(f"/proc/{worker}").exists():
            break
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()


def test_exit_codes_and_output_reach_the_parent(tmp_path):
    code = at_run(f"{READY}\noutput.emit('h\\u00e9')\nsys.stderr.write('shown\\n')")
    returned, out, err = Ran(tmp_path, code).end()
    assert (returned, out, err) == (0, "h\u00e9\n", "shown\n")
    returned, _, err = Ran(tmp_path, at_run(f"{READY} 1 / 0")).end()
    assert returned == 1
    assert "unexpected ZeroDivisionError" in err
    (report,) = (word for word in err.split() if word.endswith(".txt"))
    Path(report).unlink()


def test_a_closed_pipe_is_not_a_crash(tmp_path):
    table = "from rich.console import Console\nConsole(file=sys.stdout).print('row\\n' * 9999)"
    ran = Ran(tmp_path, at_run(f"{READY}\nsys.stdin.read()\n{table}"))
    assert ran.process.stdout is not None
    assert ran.process.stdin is not None
    ran.process.stdout.close()
    ran.process.stdin.close()
    assert ran.process.wait(timeout=30) == 0
    assert ran.process.stderr is not None
    assert ran.process.stderr.read() == ""


def test_an_unprintable_character_is_escaped(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "ascii:strict")
    code = at_run(f"{READY}\noutput.emit('h\\u00e9')\noutput.warning('\\udcff')\noutput.event('a')")
    returned, out, err = Ran(tmp_path, code).end()
    assert returned == 0
    assert out == "h\\xe9\n"
    assert "\\udcff" in err
    code = at_run(f"{READY}\noutput.event('warning', message='h\\u00e9 \\udcff')")
    _, out, _ = Ran(tmp_path, code, "config", "--json").end()
    assert json.loads(out.splitlines()[-1])["message"] == "h\u00e9 \udcff"


def test_without_fork_one_process_suffices(monkeypatch, capsys):
    monkeypatch.delattr(os, "fork")
    monkeypatch.setattr(sys, "argv", ["pimper", "--help"])
    assert supervise.main() == 0
    assert "usage: pimper" in capsys.readouterr().out


def test_the_module_is_the_command():
    ran = subprocess.run(
        [sys.executable, "-m", "pimper_torch", "clean", "nowhere"], capture_output=True, text=True
    )
    assert ran.returncode == 2
    assert ran.stderr.startswith("error: nowhere: found nothing")


def test_ignored_signals_stay_ignored():
    former = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as by nohup
    try:
        with stoppable():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, former)
