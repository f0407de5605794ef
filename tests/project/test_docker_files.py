"""docker/ fits the project: what it copies exists and is all there is, what it runs is a command, and the health check tells health."""

import fnmatch
import functools
import http.server
import json
import re
import shlex
import shutil
import socket
import subprocess
import sys
import threading
import tomllib
from pathlib import Path

import pytest
import typer
import yaml

from server.cli import app

ROOT = Path(__file__).parents[2]
DOCKERFILE = ROOT / "docker" / "Dockerfile"
COMPOSE = ROOT / "docker" / "compose.yaml"


@pytest.fixture(scope="module")
def project():
    with (ROOT / "pyproject.toml").open("rb") as file:
        return tomllib.load(file)


@pytest.fixture(scope="module")
def instructions():
    """(name, argument) of each instruction of the Dockerfile, continued lines joined."""
    lines = [line for line in DOCKERFILE.read_text().splitlines() if line.strip() and not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines))
    return [tuple(line.split(maxsplit=1)) for line in joined.splitlines()]


@pytest.fixture(scope="module")
def stages(instructions):
    """The instructions of each stage; the first list is what stands before any."""
    found = [[]]
    for name, argument in instructions:
        if name == "FROM":
            found.append([])
        found[-1].append((name, argument))
    return found


@pytest.fixture(scope="module")
def compose():
    return yaml.safe_load(COMPOSE.read_text())


def of(stage, name):
    return [argument for found, argument in stage if found == name]


def copied(stage):
    return [source for argument in of(stage, "COPY") if "--from" not in argument for source in shlex.split(argument)[:-1]]


def test_the_image_is_of_the_python_that_the_project_wants(stages, project):
    (argument,) = of(stages[0], "ARG")
    version = tuple(map(int, argument.removeprefix("PYTHON_VERSION=").split(".")))
    least = tuple(map(int, project["project"]["requires-python"].removeprefix(">=").split(".")))
    assert version >= least
    assert all(of(stage, "FROM")[0].startswith("python:${PYTHON_VERSION}-slim") for stage in stages[1:])


def test_everything_that_a_build_needs_is_copied(stages, project):
    sources = copied(stages[1])
    assert all((ROOT / source).exists() for source in sources)
    packages = {name.split(".")[0] for name in project["tool"]["setuptools"]["packages"]}
    assert packages | {"pyproject.toml", project["project"]["readme"]} == set(sources)
    assert not copied(stages[-1])


def test_the_build_context_has_what_is_copied_and_little_else(stages):
    patterns = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line and not line.startswith("#")]
    assert patterns[0] == "*"
    assert sorted(pattern[1:] for pattern in patterns if pattern.startswith("!")) == sorted(copied(stages[1]))
    assert not any(fnmatch.fnmatch(name, pattern[1:]) for name in ("docker", "tests", ".git", ".venv") for pattern in patterns[1:])


def test_the_final_stage_runs_the_one_command_without_rights(stages, project):
    final = stages[-1]
    assert [json.loads(argument) for argument in of(final, "ENTRYPOINT")] == [list(project["project"]["scripts"])]
    (user,) = of(final, "USER")
    assert int(user.split(":")[0]) > 0
    assert final.index(("USER", user)) < final.index(("ENTRYPOINT", of(final, "ENTRYPOINT")[0]))
    installed = shlex.split(re.search(r"apt-get install ([^&|;]+)", " ".join(of(final, "RUN"))).group(1))
    assert [name for name in installed if not name.startswith("--")] == ["binutils"]
    environment = " ".join(of(final, "ENV"))
    assert "POCL_CACHE_DIR=/tmp/" in environment
    assert "LIBRARY_PATH=/opt/pocl-link" in environment


def health_check(stages):
    (argument,) = of(stages[-1], "HEALTHCHECK")
    command = json.loads(argument[argument.index("CMD ") + 4 :])
    return [sys.executable, *command[1:]]


class Health(http.server.BaseHTTPRequestHandler):
    def __init__(self, status, *arguments):
        self.status = status
        super().__init__(*arguments)

    def do_GET(self):
        self.send_response(self.status if self.path == "/healthz" else 404)
        self.end_headers()

    def log_message(self, *_):
        pass


@pytest.mark.parametrize(("status", "healthy"), [(200, True), (503, False)])
def test_the_health_check_tells_health(stages, status, healthy):
    with http.server.HTTPServer(("127.0.0.1", 0), functools.partial(Health, status)) as server:
        thread = threading.Thread(target=server.handle_request)
        thread.start()
        environment = {"SECTORLIGHT_PORT": str(server.server_port)}
        done = subprocess.run(health_check(stages), check=False, capture_output=True, env=environment, timeout=30)
        thread.join()
    assert (done.returncode == 0) == healthy


def test_no_server_is_no_health(stages):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    done = subprocess.run(health_check(stages), check=False, capture_output=True, env={"SECTORLIGHT_PORT": str(port)}, timeout=30)
    assert done.returncode != 0


def test_compose_builds_this_image_of_this_version(compose, project):
    for service in compose["services"].values():
        context = (COMPOSE.parent / service["build"]["context"]).resolve()
        assert context == ROOT
        assert context / service["build"]["dockerfile"] == DOCKERFILE
        assert service["image"] == f"sectorlight:{project['project']['version']}"


def test_compose_bakes_once_before_it_serves(compose):
    bake, serve = compose["services"]["bake"], compose["services"]["serve"]
    assert serve["depends_on"]["bake"]["condition"] == "service_completed_successfully"
    assert bake["restart"] == "no"
    assert bake["command"][bake["command"].index("--output") + 1] == serve["command"][1]
    assert bake["volumes"] == ["city:/data"]
    assert serve["volumes"] == ["city:/data:ro"]
    assert set(compose["volumes"]) == {"city"}


@pytest.mark.parametrize("name", ["bake", "serve"])
def test_compose_s_commands_are_ones_that_the_program_takes(compose, name):
    words = [re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", word) for word in compose["services"][name]["command"]]
    command = typer.main.get_command(app).commands[words[0]]
    context = command.make_context(words[0], words[1:])  # raises for an option or a value that there is none of
    if name == "bake":
        from bake_jobs.scene_source import load_scene

        assert context.params["source"].startswith("procedural:")
        assert load_scene(context.params["source"]) is not None
    else:
        port = context.params["port"]
        assert context.params["host"] == "0.0.0.0"
        assert compose["services"][name]["ports"] == [f"127.0.0.1:${{PORT:-8000}}:{port}"]
        (secret,) = compose["services"][name]["secrets"]
        assert context.params["token_file"] == Path("/run/secrets") / secret
        assert secret in compose["secrets"]


def test_compose_gives_no_rights_but_room_for_kernels(compose):
    for service in compose["services"].values():
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
        assert "no-new-privileges:true" in service["security_opt"]
        (mount,) = service["tmpfs"]
        where, options = mount.split(":")
        assert where == "/tmp"
        # Docker's default is noexec, and PoCL could not load a kernel that it has built.
        assert "exec" in options.split(",")


def test_the_token_is_never_committed_nor_copied():
    ignored = (ROOT / ".gitignore").read_text().splitlines()
    assert "docker/token" in ignored
    assert "file: ${TOKEN_FILE:-./token}" in COMPOSE.read_text()


@pytest.mark.parametrize("command", [["hadolint", str(DOCKERFILE)], ["compose-lint", str(COMPOSE)]], ids=["hadolint", "compose-lint"])
def test_linters_find_nothing(command):
    linter = shutil.which(command[0], path=str(Path(sys.executable).parent))
    if linter is None:
        pytest.skip(f"{command[0]} is not installed: make test-all installs it")
    done = subprocess.run([linter, *command[1:]], check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
