"""A real browser: Chromium driven by Playwright, and a JupyterLab on this machine that it opens notebooks in.

Skipped, with a word on why, where there is no Chromium or no playwright. MINICMDM_SCREENSHOTS=FOLDER keeps the pictures
in that folder instead of pytest's own temporary one. No request may leave the machine: one that tries is stopped, and
the test fails.
"""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

FLAGS = (
    "--no-sandbox --disable-gpu --disable-dev-shm-usage --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync"
).split()
SIZE = {"width": 1280, "height": 800}
SETTINGS = {  # no news over the page; cells out of sight are in the page too
    "@jupyterlab/apputils-extension:notification": {"fetchNews": "false", "checkForUpdates": False},
    "@jupyterlab/notebook-extension:tracker": {"windowingMode": "none"},
}
PATIENCE = 300  # seconds for a server to start or a notebook to run, on a busy machine


def chromium_path(playwright) -> str | None:
    """The Chromium to drive: the one that CHROME names, the system's, or one that Playwright has installed."""
    names = [os.environ.get("CHROME", ""), "chromium", "chromium-browser", "google-chrome", "google-chrome-stable"]
    found = [path for name in names if name and (path := shutil.which(name))]
    own = playwright.chromium.executable_path
    return found[0] if found else own if Path(own).exists() else None


@pytest.fixture(scope="session")
def chromium():
    """A running browser, shared by all tests."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
    with api.sync_playwright() as playwright:
        path = chromium_path(playwright)
        if path is None:
            pytest.skip("no Chromium here: apt-get install chromium, or point CHROME at one")
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def tab(chromium):
    """The one page that all tests use in turn, 1280 x 800; what asked for an address off this machine; what failed."""
    context = chromium.new_context(viewport=SIZE, reduced_motion="reduce", service_workers="block")
    outside, broken = [], []

    def gate(route):
        if re.match(r"(file|data|blob):|https?://127\.0\.0\.1[:/]", route.request.url):
            return route.continue_()
        outside.append(route.request.url)
        route.abort()

    context.route("**/*", gate)
    page = context.new_page()
    page.set_default_timeout(30_000)
    page.on("pageerror", lambda error: broken.append(str(error)))
    page.on("websocket", lambda socket: None if "//127.0.0.1" in socket.url else outside.append(socket.url))
    return page, outside, broken


@pytest.fixture
def page(tab):
    """The page. At the end of the test: no request left the machine, no script failed."""
    page, outside, broken = tab
    outside.clear()
    broken.clear()
    yield page
    assert outside == [], f"requests left the machine: {outside}"
    assert broken == [], f"scripts failed: {broken}"


@pytest.fixture(scope="session")
def shots(tmp_path_factory):
    """The folder for screenshots."""
    folder = os.environ.get("MINICMDM_SCREENSHOTS")
    folder = Path(folder) if folder else tmp_path_factory.mktemp("screenshots")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def lab_server(tmp_path_factory, chromium):
    """A JupyterLab without a user's settings, in fast mode: (address, folder of its notebooks)."""
    pytest.importorskip("jupyterlab", reason="jupyterlab is not installed: pip install 'minicmdm[notebooks]'")
    home = tmp_path_factory.mktemp("lab")
    root, config = home / "root", home / "config"
    (config / "labconfig").mkdir(parents=True)
    root.mkdir()
    (config / "labconfig" / "default_setting_overrides.json").write_text(json.dumps(SETTINGS), encoding="utf-8")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    own = {"JUPYTER_CONFIG_DIR": config, "IPYTHONDIR": home / "ipython"} | {
        name: home / name.lower()
        for name in ("JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "JUPYTERLAB_SETTINGS_DIR", "JUPYTERLAB_WORKSPACES_DIR")
    }
    switches = {"MINICMDM_FAST": "1", "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "MPLCONFIGDIR": str(home / "mpl")}
    options = [
        "--no-browser", "--allow-root", "--ip=127.0.0.1", f"--port={port}", "--ServerApp.port_retries=0",
        "--IdentityProvider.token=", "--ServerApp.disable_check_xsrf=True", "--LabApp.expose_app_in_browser=True",
        "--LabApp.extension_manager=readonly", f"--ServerApp.root_dir={root}",
    ]  # fmt: skip
    with open(home / "log.txt", "w", encoding="utf-8") as log:
        server = subprocess.Popen(
            [sys.executable, "-m", "jupyterlab", *options],
            env=os.environ | {name: str(value) for name, value in own.items()} | switches,
            stdout=log, stderr=subprocess.STDOUT,
        )  # fmt: skip
    address = f"http://127.0.0.1:{port}"
    try:
        _wait_for(address + "/api", server, home / "log.txt")
        yield address, root
    finally:
        server.terminate()  # and its kernels with it
        try:
            server.wait(20)
        except subprocess.TimeoutExpired:
            server.kill()


def _wait_for(address: str, server: subprocess.Popen, log: Path) -> None:
    end = time.monotonic() + PATIENCE
    while server.poll() is None and time.monotonic() < end:
        try:
            with urllib.request.urlopen(address, timeout=5):
                return
        except OSError:
            time.sleep(0.2)
    pytest.fail(f"JupyterLab did not start:\n{log.read_text('utf-8')[-2000:]}", pytrace=False)


class Notebook:
    """A notebook open in JupyterLab. Cells are named by their ids."""

    def __init__(self, page, address: str, path: Path):
        self.page = page
        page.goto(f"{address}/lab/tree/{path.name}?reset", wait_until="domcontentloaded")
        page.wait_for_function("window.jupyterapp !== undefined", timeout=1000 * PATIENCE)
        page.wait_for_function(
            "jupyterapp.shell.currentWidget?.sessionContext?.session?.kernel?.status === 'idle'",
            timeout=1000 * PATIENCE,
        )
        # What a widget's callback raises is no cell's output, and JupyterLab hides it in its log.
        page.evaluate("""() => {
            window.kernelProblems = [];
            jupyterapp.shell.currentWidget.sessionContext.session.kernel.iopubMessage.connect((_, message) => {
                if (message.header.msg_type === "error") {
                    window.kernelProblems.push(`${message.content.ename}: ${message.content.evalue}`);
                } else if (message.header.msg_type === "stream" && message.content.name === "stderr") {
                    // JupyterLab asks a fresh kernel for widgets of the page before; that is nobody's fault.
                    if (!message.content.text.startsWith("No such comm")) {
                        window.kernelProblems.push(message.content.text);
                    }
                }
            });
        }""")

    def run(self) -> "Notebook":
        """Run every cell; fails at once if one fails."""
        self.page.evaluate("""() => {
            window.ended = false;
            jupyterapp.commands.execute("notebook:run-all-cells").finally(() => { window.ended = true; });
        }""")
        self.page.wait_for_function("window.ended || window.kernelProblems.length > 0", timeout=1000 * PATIENCE)
        self.check()
        return self

    def check(self) -> None:
        """Nothing failed: no cell, no callback, no widget's script; nothing was written to stderr."""
        problems = self.page.evaluate("""() => [
            ...window.kernelProblems,
            ...Array.from(jupyterapp.shell.currentWidget.content.widgets)
                .flatMap((cell) => cell.model.type === "code" ? cell.model.outputs.toJSON() : [])
                .filter((output) => output.output_type === "error").map((output) => output.evalue),
        ]""")
        assert problems == [], problems
        for sign in ("Click to show javascript error", "Error displaying widget", "Error creating widget"):
            assert self.page.get_by_text(sign).count() == 0, sign

    def cell(self, id: str):
        """The place of a cell (input and output) in the page."""
        number = self.page.evaluate(
            "(id) => jupyterapp.shell.currentWidget.content.widgets.findIndex((cell) => cell.model.id === id)", id
        )
        assert number >= 0, f"there is no cell {id}"
        cell = self.page.locator(".jp-Notebook .jp-Cell").nth(number)
        cell.scroll_into_view_if_needed()
        return cell

    def theme(self, name: str) -> None:
        """Switch to "Light" or "Dark"."""
        self.page.evaluate(f"jupyterapp.commands.execute('apputils:change-theme', {{theme: 'JupyterLab {name}'}})")
        dark = "false" if name == "Dark" else "true"
        self.page.wait_for_selector(f"body[data-jp-theme-light={dark}]", state="attached")

    def shoot(self, place, path: Path) -> None:
        """Keep two pictures of what a student sees of `place`, one in each theme: path and its -dark twin."""
        for name, ending in (("Dark", "-dark"), ("Light", "")):
            self.theme(name)
            place.scroll_into_view_if_needed()
            self.page.screenshot(path=path.with_name(path.stem + ending + ".png"))


@pytest.fixture
def open_notebook(page, lab_server):
    """A function that puts a notebook (a path, or sources {id: code}) into JupyterLab and opens it.

    `last` leaves out what comes after that cell.
    """
    address, root = lab_server

    def open_it(source, last: str | None = None) -> Notebook:
        if isinstance(source, Path):
            path, notebook = root / source.name, json.loads(source.read_text(encoding="utf-8"))
            for cell in notebook["cells"]:  # nothing stored may pass for something made here
                if cell["cell_type"] == "code":
                    cell["outputs"], cell["execution_count"] = [], None
        else:
            path, notebook = root / f"{next(iter(source))}.ipynb", as_notebook(source)
        if last is not None:
            del notebook["cells"][[cell["id"] for cell in notebook["cells"]].index(last) + 1 :]
        path.write_text(json.dumps(notebook), encoding="utf-8")
        return Notebook(page, address, path)

    yield open_it
    page.evaluate("jupyterapp.shell.currentWidget.sessionContext.shutdown()")  # its kernel would keep its memory


def as_notebook(sources: dict[str, str]) -> dict:
    """Code cells by their ids as a notebook."""
    cells = [
        {"cell_type": "code", "id": id, "source": source, "metadata": {}, "outputs": [], "execution_count": None}
        for id, source in sources.items()
    ]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
