"""A recording of Rerun shown in the browser from this machine alone.

Rerun's Python library serves its page on all interfaces, so its command with ``--bind`` is used. That page asks
Google for a font and reports to Rerun whatever the configuration says; it is therefore passed on by a server of our
own, with a policy by which the browser lets it speak to nobody but this machine.
"""

import http.client
import http.server
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

from echogrid.errors import UsageError
from echogrid.extras import need

_HERE = "127.0.0.1"

_WEB_PORT, _DATA_PORT = 9090, 9876
"""Rerun's own ports; another is taken where one of them is in use."""

_START_S = 30.0


class Served:
    """A recording that is being shown."""

    def __init__(self, address: str, process: subprocess.Popen):
        self.address, self._process = address, process

    def wait(self) -> None:
        """Return when Rerun has ended."""
        self._process.wait()


@contextmanager
def served(recording: Path) -> Generator[Served]:
    """Show a recording in Rerun's web viewer until the block ends.

    Everything listens on 127.0.0.1 alone. Rerun is run with a configuration of its own that says no to analytics; the
    user's is neither read nor changed.

    Args:
        recording: the file (.rrd).

    Raises:
        UsageError: Rerun is not installed, or does not start.
    """
    need("--rerun", "viewer")
    with TemporaryDirectory(prefix="echogrid-rerun-") as home, ExitStack() as stack:
        rerun = [sys.executable, "-m", "rerun_cli"]
        environment = _without_analytics(rerun, Path(home))
        page, data, behind = (_free_port(wanted) for wanted in (_WEB_PORT, _DATA_PORT, 0))
        said = stack.enter_context(open(Path(home) / "said", "w+b"))
        process = subprocess.Popen(
            [*rerun, "--serve-web", "--bind", _HERE, f"--port={data}", f"--web-viewer-port={behind}", recording],
            env=environment | {"RUST_LOG": "warn"},
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
            start_new_session=True,
        )
        stack.callback(_end, process)
        _await(process, (behind, data), Path(home) / "said")
        server = stack.enter_context(_Page((_HERE, page), _handler(behind, data)))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        stack.callback(server.shutdown)
        yield Served(f"http://{_HERE}:{page}/?url={quote(f'rerun+http://{_HERE}:{data}/proxy', safe='')}", process)


class _Page(http.server.ThreadingHTTPServer):
    daemon_threads = True


def _handler(behind: int, data: int) -> type[http.server.BaseHTTPRequestHandler]:
    """What passes on the page at port ``behind``, and lets it speak to the server of the recording at ``data``."""
    policy = (
        "default-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; "
        f"connect-src 'self' blob: data: http://{_HERE}:{data}; form-action 'none'; base-uri 'none'"
    )

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            connection = http.client.HTTPConnection(_HERE, behind, timeout=30)
            try:
                connection.request("GET", self.path)
                answer = connection.getresponse()
                body = answer.read()
            except (OSError, http.client.HTTPException):
                self.send_error(502)
                return
            finally:
                connection.close()
            kind = answer.headers.get("Content-Type", "application/octet-stream")
            if kind.startswith("text/html"):
                # No policy stops a browser from opening a connection ahead for such a link.
                body = re.sub(rb"<link\b[^>]*https?://[^>]*>", b"", body)
            self.send_response(answer.status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Content-Security-Policy", policy)
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            with suppress(OSError):  # the browser may have gone
                self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002
            """The library prints nothing."""

    return Handler


def _without_analytics(rerun: list[str], home: Path) -> dict[str, str]:
    """The environment in which Rerun's command finds its configuration in a folder, and analytics off in it."""
    places = ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME")
    environment = os.environ | dict.fromkeys(places, str(home))
    subprocess.run([*rerun, "analytics", "disable"], env=environment, capture_output=True, check=False)
    if not _analytics_are_off(home):
        raise UsageError("--rerun: found no way to turn off the analytics of this rerun, expected rerun-sdk 0.41")
    return environment


def _analytics_are_off(home: Path) -> bool:
    with suppress(OSError, ValueError, KeyError, TypeError):
        files = list(home.rglob("analytics.json"))
        return bool(files) and all(json.loads(file.read_bytes())["analytics_enabled"] is False for file in files)
    return False


def _free_port(wanted: int) -> int:
    for port in (wanted, 0):
        with suppress(OSError), socket.socket() as place:
            place.bind((_HERE, port))
            return place.getsockname()[1]
    raise UsageError(f"--rerun: found no free port on {_HERE}, expected one")


def _await(process: subprocess.Popen, ports: tuple[int, ...], said: Path) -> None:
    """Wait until it listens."""
    end = time.monotonic() + _START_S
    for port in ports:
        while True:
            with suppress(OSError), socket.create_connection((_HERE, port), timeout=1):
                break
            if process.poll() is not None or time.monotonic() > end:
                words = said.read_text(encoding="utf-8", errors="replace").split("\n")
                last = next((line for line in reversed(words) if line.strip()), "nothing")
                raise UsageError(f"--rerun: found that rerun does not start ({last.strip()[:200]}), expected it to")
            time.sleep(0.05)


def _end(process: subprocess.Popen) -> None:
    """End it with all that it has started."""
    # At SIGINT the command ends what it has started before itself; the others would not wait for that.
    for sign in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, sign)
        with suppress(subprocess.TimeoutExpired):
            process.wait(3)
            return
