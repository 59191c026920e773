"""The `magic` command: exit codes, help, config files and overrides."""

import json

import pytest
import yaml

from magic_cli.main import COMMANDS, run_command


def test_help_lists_every_command(capsys):
    assert run_command(["--help"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in COMMANDS)


def test_no_command_is_a_usage_error():
    assert run_command([]) == 2


def test_an_unknown_command_is_a_usage_error(capsys):
    assert run_command(["sing"]) == 2
    assert "sing" in capsys.readouterr().err


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_explains_itself(name, capsys):
    try:
        code = run_command([name, "--help"])
    except SystemExit as ended:
        code = ended.code
    printed = capsys.readouterr()
    assert code == 0
    assert f"magic {name}" in printed.out + printed.err


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "data", "--tracking.solver", "guess"],
        ["run", "data", "--no-such-option"],
        ["run"],
        ["run", "data", "--config", "absent.yaml"],
    ],
)
def test_a_wrong_command_line_exits_with_2(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    try:
        code = run_command(arguments)
    except SystemExit as ended:
        code = ended.code
    assert code == 2


def test_a_missing_dataset_exits_with_1_and_names_it(capsys, tmp_path):
    assert run_command(["run", str(tmp_path / "nowhere")]) == 1
    assert "nowhere" in capsys.readouterr().err


def test_options_override_the_config_file(tmp_path):
    from magic_cli.options import parse
    from magic_cli.run import RunConfig

    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump({"dataset": "here", "scale": 0.5, "submap": {"frames": 20}}))
    config = parse(
        RunConfig,
        ["--config", str(path), "--submap.frames", "30"],
        prog="magic run",
        description="",
    )
    assert (config.dataset, config.scale, config.submap.frames) == ("here", 0.5, 30)


def test_a_saved_run_config_is_accepted_back(tmp_path):
    from magic_cli.run import RunConfig
    from magic_core.config import load_yaml, save_yaml

    config = RunConfig(dataset="somewhere", known_start=True, loops="off")
    save_yaml(config, tmp_path / "config.yaml")
    assert load_yaml(RunConfig, tmp_path / "config.yaml") == config


def test_json_is_the_last_line_of_stdout(capsys, tmp_path):
    folder = tmp_path / "empty"
    folder.mkdir()
    assert run_command(["check-data", str(folder), "--json"]) == 1
    report = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert report["ok"] is False
    failed = [found["detail"] for found in report["findings"] if found["status"] == "fail"]
    assert any("empty" in detail for detail in failed)


WITH_EXAMPLES = sorted(set(COMMANDS) - {"bench"})


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_help_is_short_enough_to_read_and_has_examples(name, capsys):
    code = ended(run_command, [name, "--help"])
    text = capsys.readouterr().out
    assert code == 0
    assert len(text.splitlines()) < 90
    examples = [line.split("#")[0].strip() for line in text.splitlines() if "  magic " in line]
    assert any(line.startswith(f"magic {name}") for line in examples)


def test_all_settings_are_listed_on_demand(capsys):
    assert ended(run_command, ["run", "--help"]) == 0
    short = capsys.readouterr().out
    assert "--tracking.*" in short
    assert "--tracking.solver {" not in short
    assert ended(run_command, ["run", "--help-all"]) == 0
    assert "--tracking.solver {" in capsys.readouterr().out


def test_a_live_camera_is_not_for_a_run_that_reads_twice(capsys):
    assert run_command(["run", "realsense:"]) == 2
    assert "magic agent realsense: --server" in capsys.readouterr().err


@pytest.mark.parametrize("module", ["run", "serve", "agent"])
def test_the_yaml_saved_beside_results_is_accepted_back(module, tmp_path):
    import importlib

    from magic_cli.options import parse
    from magic_core.config import save_yaml

    names = {"run": "RunConfig", "serve": "ServeCommand", "agent": "AgentCommand"}
    cls = getattr(importlib.import_module(f"magic_cli.{module}"), names[module])
    given = [] if module == "serve" else ["somewhere"]
    first = parse(cls, given, prog=f"magic {module}", description="")
    save_yaml(first, tmp_path / "config.yaml")
    again = parse(cls, ["--config", str(tmp_path / "config.yaml")], prog="magic", description="")
    assert again == first


def ended(function, *arguments):
    """The exit code, also of a command that ends the process."""
    try:
        return function(*arguments)
    except SystemExit as end:
        return end.code
