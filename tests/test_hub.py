"""Agents of the Hugging Face Hub, by a stand-in of it on this machine."""

import hashlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import publish
import pytest
import torch
import yaml

import sb3_quad
from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main

constants = pytest.importorskip("huggingface_hub.constants")


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    """The files of the stand-in, bytes by their paths in it."""
    files: dict[str, bytes] = {}

    class Shelf(BaseHTTPRequestHandler):
        def do_HEAD(self):
            content = files.get(self.path.replace("/resolve/main/", "/"))
            self.send_response(404 if content is None else 200)
            self.send_header("X-Repo-Commit", "0" * 40)
            self.send_header("ETag", f'"{hashlib.sha256(content or b"").hexdigest()}"')
            self.send_header("Content-Length", str(len(content or b"")))
            self.end_headers()
            return content

        def do_GET(self):
            self.wfile.write(self.do_HEAD() or b"")

        def log_message(self, *arguments):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Shelf)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setattr(
        constants,
        "HUGGINGFACE_CO_URL_TEMPLATE",
        _address(server) + "/{repo_id}/resolve/{revision}/{filename}",
    )
    monkeypatch.setattr(constants, "ENDPOINT", _address(server))
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    yield files
    server.shutdown()
    server.server_close()


def _address(server):
    return f"http://127.0.0.1:{server.server_port}"


def test_an_agent_of_the_hub_is_read_as_data_and_flies_as_it_was_trained(shelf, capsys):
    own = sb3_quad.pretrained_path("itm-recovery").read_bytes()
    shelf["/someone/racer/racer.zip"] = shelf["/someone/racer/other.zip"] = own
    theirs = sb3_quad.load_pretrained("hf:someone/racer").policy.state_dict()
    for name, tensor in sb3_quad.load_pretrained("itm-recovery").policy.state_dict().items():
        torch.testing.assert_close(theirs[name], tensor, rtol=0, atol=0)
    assert sb3_quad.env_kwargs("hf:someone/racer/other.zip") == sb3_quad.env_kwargs("itm-recovery")
    assert main(["enjoy", "hf:someone/racer", "--no-render", "-n", "20"]) == 0


@pytest.mark.slow
def test_published_for_the_hub_an_agent_has_what_the_hub_shows(
    shelf, tmp_path, monkeypatch, short_cards
):
    monkeypatch.setattr(publish, "FILM", ("-n", "20", "--size", "64x64"))
    command = ["itm-recovery", "--name", "racer", "--hub", "--episodes", "2", "-o", str(tmp_path)]
    assert publish.main(command) == 0
    folder = tmp_path / "racer"
    front = (folder / "README.md").read_text(encoding="utf-8").split("---\n")[1]
    assert yaml.safe_load(front)["library_name"] == "stable-baselines3"
    assert (folder / "replay.mp4").stat().st_size > 1000
    shelf["/me/racer/racer.zip"] = (folder / "racer.zip").read_bytes()
    assert sb3_quad.load_pretrained("hf:me/racer").num_timesteps
    assert publish.main(command) == 2


def test_what_the_hub_lacks_or_a_zip_that_runs_code_is_refused_in_one_line(shelf, capsys):
    shelf["/someone/bad/bad.zip"] = b"PK\x03\x04 no zip"
    for address in ("hf:someone/none", "hf:someone", "hf:someone/bad"):
        with pytest.raises(ConfigError, match=address):
            sb3_quad.load_pretrained(address)
    assert main(["export", "hf:someone/none", "--format", "c"]) == 2
    error = capsys.readouterr().err
    assert "hf:someone/none" in error and error.count("\n") == 1
