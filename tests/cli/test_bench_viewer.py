"""`magic bench viewer`: what watching costs, and that it stays bounded."""

from __future__ import annotations

import json

import pytest

from magic_cli.main import run_command


def costs(capsys, *options: str) -> dict:
    assert run_command(["bench", "viewer", "--json", *options]) == 0
    return json.loads(capsys.readouterr().out.strip().splitlines()[-1])["updates"]


def test_a_look_without_news_sends_nothing_and_corrections_send_no_gaussians(capsys):
    sent = costs(capsys, "--gaussians", "20000", "--submaps", "5", "--frames", "10")
    whole, nothing, more, moved = (cell["bytes"] for cell in sent.values())
    assert whole > 16_000 * 30  # bytes of a Gaussian
    assert nothing == 0
    assert 4_000 * 30 < more < 0.6 * whole
    assert moved < 0.05 * whole


@pytest.mark.slow
def test_more_gaussians_than_the_limit_are_thinned(capsys):
    options = ["--gaussians", "40000", "--submaps", "4", "--frames", "10"]
    limited = costs(capsys, *options, "--max-splats", "5000")
    images = 4 * 60_000  # the anchors' thumbnails are noise, which compresses badly
    assert limited["the whole map"]["bytes"] < 5_000 * 32 + images


@pytest.mark.parametrize("option", ["--gaussians", "--submaps", "--max-splats", "--frames"])
def test_nothing_at_all_is_refused(option, capsys):
    assert run_command(["bench", "viewer", option, "0"]) == 2
    assert "at least 1" in capsys.readouterr().err
