"""Help and refusals do not load slow modules: torch alone takes more than a second."""

import subprocess
import sys

HEAVY = {"torch", "numpy", "scipy", "kornia", "numba", "pycolmap"}


def answers(code: str, folder: object = None) -> list[str]:
    """Run code in a new process, and return the lines it prints."""
    line = [sys.executable, "-c", f"import sys\nfrom pimper_torch.cli.main import main\n{code}"]
    ran = subprocess.run(line, capture_output=True, text=True, cwd=folder)
    assert ran.returncode == 0, ran.stderr
    return [line for line in ran.stdout.splitlines() if line.startswith("answered")]


REFUSED = [
    ["reconstruct", "photos", "-o", "out", "--sede", "3"],
    ["reconstruct", "nowhere", "-o", "out"],
    ["reconstruct", "photos", "-o", "out", "--masks", "nowhere"],
    ["reconstruct", "photos", "-o", "out", "--reference", "nosuch"],
    ["demo", "--preset", "papr"],
    ["demo", "-o", "photos"],
    ["export", "nowhere", "-o", "out", "--format", "maps"],
    ["export", "photos", "-o", "out", "--format", "gif"],
    ["export", "photos", "-o", "photos", "--format", "maps"],
    ["gamma", "nowhere"],
    ["clean", "nowhere"],
    ["config", "nowhere"],
]


def test_help_and_refusals_load_no_slow_modules(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.png").write_bytes(b"")
    found = answers(
        f"""if True:
        from pimper_torch.cli.main import _COMMANDS
        heavy = {HEAVY}
        assert main(["--help"]) == 0
        print("answered 0", *heavy & {{*sys.modules}})
        for command in _COMMANDS:
            try:
                main([command, "--help-all"])
            except SystemExit as ended:
                print("answered", ended.code, *heavy & {{*sys.modules}}, command)
        for line in {REFUSED}:
            print("answered", main(line), *heavy & {{*sys.modules}}, *line)
        """,
        tmp_path,
    )
    assert len(found) > 20
    assert found[-len(REFUSED) :] == [f"answered 2 {' '.join(line)}" for line in REFUSED]
    assert all(len(line.split()) <= 3 for line in found[: -len(REFUSED)])


def test_a_closed_pipe_gives_no_traceback():
    code = """if True:
        import os
        reading, writing = os.pipe()
        os.dup2(writing, 1)
        os.close(reading)
        sys.exit(main(["gamma", "--help"]))
    """
    assert answers(code) == []
