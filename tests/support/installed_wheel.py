"""Build sdist and wheel, install the wheel outside the checkout, and use the wheel there as a user would.

``python -m tests.support.installed_wheel`` compares the content with ``git ls-files``, runs every command once, and
lets mypy check the installed copy.  ``--tests`` then runs tests against the installed copy.  ``--lowest`` installs
the lowest versions that ``pyproject.toml`` allows.  ``--python`` selects another interpreter.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {"impact_posture": "impact_posture", "cli": "impact_posture_cli", "robots": "impact_posture_robots"}
# Files that only a checkout contains.
UNSHIPPED = (".ci/", ".gitignore")

# Every command of the app with fast options.  Commands in the same row run one after the other.
COMMANDS = [
    ["simulate solo8-push --format png --out run"],
    ["compare solo8-push --controllers nominal --seeds 1 --jobs 1 --format png --out comparison"],
    ["reproduce --scenario solo8-push --seeds 1 --jobs 1 --format png --out reproduction"],
    [
        "optimize ur5 --normal 0 0 1 --format png --out result",
        "plot result --format svg --out pictures",
        "report result",
        "view result",
    ],
    ["robots", "inspect tilthex_arm", "evaluate ur5 --normal 0 0 1", "verify ur5 --samples 2"],
    ["codegen ur5 --normal 0 0 1 --compile --out exported", "codegen ur5 --controller arm --out arm"],
    ["sweep grid.toml --workers 1 --out grid", "sweep show grid"],
]
# Input file of the command `sweep`.
GRID = """grid = { x = [0.0, 0.05] }
[problem]
robot = "ur5"
normal = [0, 0, 1]
collision = false
starts = 1
"""


class Failed(Exception):
    """Exception for a failed check; the message names the check."""


def run(command: list[str], folder: Path, fine: tuple[int, ...] = (0,)) -> subprocess.CompletedProcess[str]:
    """Run a command outside the checkout, without environment variables that make Python import from the checkout."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON") and k != "MYPYPATH"}
    environment |= {"IMPACT_POSTURE_CACHE": str(folder / "cache"), "COLUMNS": "100", "BROWSER": "true"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in fine:
        raise Failed(f"{' '.join(command)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done


def tracked() -> list[str]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [name for name in listed.split("\0") if name and (ROOT / name).is_file()]


def copy(names: list[str], folder: Path) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / name)
    return folder


def digests(files: Iterator[tuple[str, bytes]]) -> dict[str, str]:
    return {name: hashlib.sha256(content).hexdigest() for name, content in files}


def wheel_files(wheel: Path) -> dict[str, str]:
    with zipfile.ZipFile(wheel) as archive:
        return digests((n, archive.read(n)) for n in archive.namelist() if not n.endswith("/"))


def sdist_files(sdist: Path) -> dict[str, str]:
    with tarfile.open(sdist) as archive:
        members = [(m.name.partition("/")[2], archive.extractfile(m)) for m in archive.getmembers() if m.isfile()]
        return digests((name, file.read()) for name, file in members if file is not None)


def compare(what: str, content: dict[str, str], expected: dict[str, str]) -> None:
    faults = [f"missing: {n}" for n in sorted(expected.keys() - content.keys())]
    faults += [f"not tracked by git: {n}" for n in sorted(content.keys() - expected.keys())]
    faults += [f"different: {n}" for n in sorted(content.keys() & expected.keys()) if content[n] != expected[n]]
    if faults:
        raise Failed(f"{what} differs from the files in git:\n  " + "\n  ".join(faults))


def build(work: Path) -> Path:
    """Build the sdist from the checkout, and the wheel from the sdist and from a clean copy.  Compare all three."""
    names, builder = tracked(), [sys.executable, "-m", "build", "--quiet"]
    source = copy(names, work / "source")
    with ThreadPoolExecutor() as pool:
        jobs = [pool.submit(run, [*builder, *command], work) for command in (
            ["--outdir", "dist", str(ROOT)], ["--wheel", "--outdir", "direct", str(source)],
        )]  # fmt: skip
        for job in jobs:
            job.result()
    (sdist,), (wheel,), (direct,) = (list((work / p).glob(g)) for p, g in (
        ("dist", "*.tar.gz"), ("dist", "*.whl"), ("direct", "*.whl"),
    ))  # fmt: skip
    state = digests((n, (ROOT / n).read_bytes()) for n in names)
    shipped = {n: d for n, d in state.items() if not n.startswith(UNSHIPPED)}
    written = ("PKG-INFO", "setup.cfg", "impact_posture.egg-info/")
    compare(sdist.name, {n: d for n, d in sdist_files(sdist).items() if not n.startswith(written)}, shipped)
    packaged = {
        f"{PACKAGES[top]}/{rest}": digest
        for name, digest in state.items()
        for top, _, rest in [name.partition("/")]
        if top in PACKAGES
    }
    content = wheel_files(wheel)
    compare(wheel.name, {n: d for n, d in content.items() if ".dist-info/" not in n}, packaged)
    compare("the wheel made without the sdist", wheel_files(direct), content)
    print(f"  {len(shipped)} files in the sdist, {len(packaged)} in the wheel, as in git")
    return wheel


def install(work: Path, wheel: Path, extras: str, lowest: bool) -> None:
    """Install the wheel with only the given extras."""
    python = str(work / "env" / "bin" / "python")
    pip = [python, "-m", "pip", "install", "--quiet", "--no-compile", "--disable-pip-version-check"]
    if lowest:
        # pip cannot select the lowest versions, but uv can.
        run([*pip, "uv"], work)
        uv = [python, "-m", "uv", "pip", "install", "--quiet", "--python", python, "--resolution", "lowest-direct"]
        named = [word for extra in extras.split(",") for word in ("--extra", extra)]
        run([*uv, *named, "-r", str(ROOT / "pyproject.toml")], work)
        run([*pip, "--no-deps", str(wheel)], work)
    else:
        run([*pip, f"{wheel}[{extras}]"], work)
    run([python, "-m", "pip", "check"], work)


def commands(work: Path, programs: Path) -> None:
    """Run every command of the app once."""
    ask = "import typer, impact_posture_cli.app as m; print(m.__file__, *typer.main.get_command(m.app).commands)"
    where, *names = run([str(programs / "python"), "-c", ask], work).stdout.split()
    if not Path(where).is_relative_to(programs.parent):
        raise Failed(f"the command ran from {where}, not from the installed wheel")
    listed = {line.split()[0] for row in COMMANDS for line in row}
    if listed != set(names):
        raise Failed(f"COMMANDS and the commands of the app differ: {sorted(listed ^ set(names))}")

    (work / "grid.toml").write_text(GRID, encoding="utf-8")

    def row(lines: list[str]) -> None:
        for line in lines:
            done = run([str(programs / "impact-posture"), *line.split()], work)
            if not done.stdout.strip() or "Traceback" in done.stderr:
                raise Failed(f"{line}:\n{done.stdout}{done.stderr}")

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(row, COMMANDS))
    print(f"  {len(names)} commands: {' '.join(names)}")


@contextmanager
def planted(file: Path, text: str) -> Iterator[None]:
    before = file.read_text(encoding="utf-8")
    file.write_text(before + text, encoding="utf-8")
    try:
        yield
    finally:
        file.write_text(before, encoding="utf-8")


def types(work: Path, programs: Path) -> None:
    """Let mypy check the installed copy.  mypy must report the error that this function adds."""
    command = [str(programs / "mypy"), "--config-file", str(ROOT / "pyproject.toml"), "--cache-dir", "mypy"]
    for package in PACKAGES.values():
        command += ["-p", package]
    print("  " + run(command, work).stdout.strip())
    (file,) = (programs.parent / "lib").glob("python*/site-packages/impact_posture/experiment/jobs.py")
    with planted(file, '\nPLANTED: int = "a word"\n'):
        said = run([*command, "--show-absolute-path"], work, fine=(1,)).stdout
    if f"{file}:" not in said or "Found 1 error" not in said:
        raise Failed(f"mypy did not report the error added to {file}:\n{said}")
    print(f"  {next(line for line in said.splitlines() if 'error:' in line).replace(str(work), '…')} (planted)")


def suite(work: Path, programs: Path, arguments: list[str]) -> None:
    """Run tests in a copy of the checkout without the two packages, so that tests import the installed packages."""
    folder = copy([n for n in tracked() if n.split("/")[0] not in PACKAGES], work / "tests")
    done = subprocess.run([str(programs / "python"), "-m", "pytest", "-q", *arguments], cwd=folder, check=False)
    if done.returncode:
        raise Failed("tests failed against the installed wheel")


@contextmanager
def step(what: str) -> Iterator[None]:
    print(f"{what} …", flush=True)
    start = time.monotonic()
    yield
    print(f"  {time.monotonic() - start:.0f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--python", default=sys.executable, help="the interpreter to install for")
    parser.add_argument("--lowest", action="store_true", help="the lowest versions that pyproject.toml allows")
    parser.add_argument("--tests", nargs=argparse.REMAINDER, help="arguments of pytest, all that follow")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="impact-posture-wheel-") as name:
        work = Path(name).resolve()
        programs = work / "env" / "bin"
        with step("sdist and wheel"):
            wheel = build(work)
        with step("install, with what a user needs"):
            run([options.python, "-m", "venv", "env"], work)
            install(work, wheel, "sim,sweep", options.lowest)
        with step("every command"):
            commands(work, programs)
        with step("install, with all extras"):
            install(work, wheel, "sim,sweep,test,docs", options.lowest)
        # mypy needs recent type stubs of other packages, for the Python version in pyproject.toml.  For an older
        # Python, mypy cannot read the stubs of newer NumPy versions.
        if not options.lowest and options.python == sys.executable:
            with step("types"):
                types(work, programs)
        if options.tests is not None:
            with step("tests"):
                suite(work, programs, options.tests)


if __name__ == "__main__":
    try:
        main()
    except Failed as failure:
        sys.exit(str(failure))
