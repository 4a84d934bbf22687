"""A result folder in the viewer, by command and in Python."""

import json
import os
import signal
import subprocess
import sys
from urllib.request import urlopen

import pytest
from scenes import write_ball

from pimper_torch.chains.chain_config import CoarseToFineConfig
from pimper_torch.cli.main import main
from pimper_torch.export import results
from pimper_torch.runtime.errors import InputError, PimperWarning
from pimper_torch.viewer.show import add_folder, show

pytest.importorskip("viser")


@pytest.fixture
def folder(reconstruction, tmp_path, small_pictures):
    """A result folder without its photographs."""
    scale = {"factor": 2.0, "unit": "cm"}
    about = {"photographs": str(tmp_path / "gone"), "masks": None, "scale": scale}
    results.write_result(reconstruction, CoarseToFineConfig(), tmp_path / "out", about=about)
    return tmp_path / "out"


def test_without_photographs_the_rest_is_shown_with_a_message(viewer, folder):
    with pytest.warns(PimperWarning, match="shows no photographs"):
        add_folder(viewer, folder)
    scene = viewer.server.scene
    assert scene.get_handle_by_name("/surfaces/0: result") is not None
    assert scene.get_handle_by_name("/cameras/00002").image is None
    assert viewer.unit == "cm"


def test_a_folder_without_a_surface_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"mesh\.ply"):
        show(tmp_path, port=0)


@pytest.fixture
def ball(tmp_path):
    return write_ball(tmp_path / "ball.ply", level=2)


def test_the_command_serves_a_page_until_ctrl_c(ball):
    code = "import sys; from pimper_torch.cli.supervise import main; sys.exit(main())"
    line = [sys.executable, "-c", code, "view", str(ball), "--port", "0", "--json"]
    # Background processes of a shell ignore Ctrl-C, and so do their children.
    with subprocess.Popen(
        line,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        for written in process.stdout:
            event = json.loads(written)
            if event["event"] == "view":
                break
        with urlopen(event["address"], timeout=10) as answer:
            assert answer.status == 200
        os.kill(process.pid, signal.SIGINT)
        assert process.stdout.read() == ""
        assert process.wait(timeout=30) == 0


def test_errors_are_printed_before_the_address(tmp_path, capsys):
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\n")
    assert main(["view", str(tmp_path / "broken.ply"), "--port", "0"]) == 2
    captured = capsys.readouterr()
    assert "broken.ply" in captured.err
    assert "viewer is at" not in captured.out + captured.err


@pytest.mark.parametrize(
    ("line", "needed"),
    [
        (["nowhere"], "found nothing"),
        (["{ball}", "--port", "70000"], "0 to 65535"),
        (["{ball}", "--host", "192.0.2.1"], "an address of this machine"),
    ],
)
def test_the_command_refuses(line, needed, ball, capsys):
    assert main(["view", *(word.format(ball=ball) for word in line)]) == 2
    assert needed in " ".join(capsys.readouterr().err.split())
