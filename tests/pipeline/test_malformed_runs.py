"""Files of a run that anybody may have changed: every command answers with one sentence and exit code 3."""

import copy
import hashlib
import json
import math

import pytest
import torch
from safetensors.torch import save

from warpgs.app.cli import main
from warpgs.errors import DataError
from warpgs.pipeline.model.table import load as load_model, save as save_model
from warpgs.pipeline.run import folder as checkpoint
from warpgs.pipeline.run.folder import TENSORS, load_checkpoint, open_run, read_record, stored_request
from warpgs.report.progress import read_events
from warpgs.synthetic.demo import write_demo

FLAGS = ["--steps", "6", "--device", "cpu", "--init.source", "random", "--init.random-count", "50", "--preset", "3dgs"]
NASTY = [None, True, -1, 0.5, 10**30, "", "x", [], {}, [[]], "a\0", math.nan]
"""Values put in place of each value of a file."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("malformed")
    write_demo(folder / "scene", views=8, width=32, height=32)
    assert main(["fit", str(folder / "scene"), "--out", str(folder / "run"), *FLAGS]) == 0
    return folder, json.loads((folder / "run" / "config.json").read_text())


@pytest.fixture
def run(made, tmp_path):
    for name in ("config.json", TENSORS, "metrics.jsonl"):
        (tmp_path / name).write_bytes((made[0] / "run" / name).read_bytes())
    return tmp_path


def places(value, path=()):
    """The path of each value in a file, but for those below the settings of the fit, of which few are read back."""
    yield path
    if path[:1] == ("config",) and len(path) > 1:
        return
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield from places(value[key], (*path, key))


def settings(value, path=("config",)):
    """The path of each value among the settings of the fit."""
    yield path
    for key in value if isinstance(value, dict) else ():
        yield from settings(value[key], (*path, key))


def replaced(value, path, new):
    if not path:
        return new
    whole = copy.deepcopy(value)
    inner = whole
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = new
    return whole


def shortened(record):
    (name, *_) = record["train"]
    return record | {"train": [name], "test": [], "cameras": {name: record["cameras"][name]}, "versions": {"warpgs": "0.2.0"}}


def put_record(folder, record):
    (folder / "config.json").write_text(json.dumps(record))


def put_checkpoint(folder, tensors, state):
    text = state if isinstance(state, str) else json.dumps(state)
    tensors = {n: t.contiguous() for n, t in tensors.items()}
    body = save(tensors, {"format": str(checkpoint.FORMAT), "version": "0.2.0", "state": text})
    (folder / TENSORS).write_bytes(body + hashlib.sha256(body).digest())


def test_a_path_that_is_too_long_for_any_system(made, run, capsys):
    put_record(run, replaced(made[1], ("scene", "path"), "x" * 5000))
    for command in (["eval", str(run), "--device", "cpu"], ["fit", "--out", str(run), "--resume"]):
        assert main(command) == 3 and "internal error" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"format": 2, "config": ', "not valid JSON"), ("[]", "not a record of a fit"), ("9" * 5000, "not valid JSON"),
        ('{"a":' * 100_000, "nested deeper"), ("\xff", "not valid JSON"),
    ],
)  # fmt: skip
def test_a_record_that_is_no_json_object(run, text, words):
    (run / "config.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=words):
        open_run(run, "cpu")


@pytest.mark.parametrize(
    ("values", "least"), [(("x", None, -1), 200), pytest.param((5, [], {}, 1e300, True), 300, marks=pytest.mark.slow)]
)
def test_settings_of_another_kind(made, run, values, least):
    """Every setting is what `--resume` takes it for, or the record is refused; null may stand where it means a choice."""
    record, checked = made[1], 0
    for path in settings(record["config"]):
        for new in values:
            put_record(run, replaced(record, path, new))
            try:
                config = stored_request(run).config
            except DataError as e:
                assert "config.json" in str(e)
                checked += 1
                continue
            found = config.to_json()
            for key in path[1:]:
                found = found[key]
            empty = new in ([], {}) and isinstance(found, type(new))  # no loss terms, and a group of defaults
            assert empty or (found == new and not isinstance(new, list | dict)), (path, new)
    assert checked > least


@pytest.mark.parametrize(("name", "value"), [("loss", "x"), ("loss", None), ("loss", []), ("more", 1)])
def test_a_group_of_settings_of_another_kind(made, run, capsys, name, value):
    put_record(run, replaced(made[1], ("config", name), value))
    assert main(["fit", "--out", str(run), "--resume"]) == 3
    words = "config.loss must be an object" if name == "loss" else "invalid settings"
    error = capsys.readouterr().err
    assert f"config.json: {words}" in error or words in error


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("cameras",), "x", "cameras must be an object"),
        (("cameras", "000.png", "viewmat"), [[1]], "viewmat must be a list of 4"),
        (("cameras", "000.png", "K", 0, 0), "1", r"K\[0\]\[0\] must be a finite number"),
        (("cameras", "000.png", "width"), 10**9, "width must be a whole number from 1 to"),
        (("cameras", "000.png", "fish"), 1, "fish is unknown"), (("cameras",), {}, "cameras lacks the view"),
        (("normalization",), None, "normalization must be an object"),
        (("normalization",), {}, "normalization.offset is missing"),
        (("normalization", "scale"), 0, "above 0"), (("normalization", "offset"), [1, 2], "a list of 3"),
        (("train",), [], "must name a view"), (("train",), "000.png", "train must be a list"),
        (("train", 0), "../a", "relative path"),
        (("background",), [0, 0], "a list of 3"), (("config", "rule"), "none", "config.rule must be one of exact"),
        (("config",), [], "config must be an object"), (("versions",), "x", "versions must be an object"),
        (("scene", "downscale"), "2", "scene.downscale"), (("scene", "code"), "x", "scene.code is unknown"),
        (("scene", "path"), "a\0b", "without a zero byte"),
    ],
)  # fmt: skip
def test_a_record_with_a_value_that_cannot_be(made, run, path, value, words):
    """Both who opens the run and who continues it read it through the same schema; the place is named."""
    put_record(run, replaced(made[1], path, value))
    for read in (read_record, open_run):
        with pytest.raises(DataError, match=rf"config\.json: incomplete or damaged \(.*{words}"):
            read(run)


@pytest.mark.parametrize(
    ("place", "values", "words"),
    [
        (("viewmat", 0, 0), (-1.0, 2.0, 1e300), "viewmat scales or"), (("viewmat", 1, 3), (1e13,), "viewmat must"),
        (("viewmat", 3, 3), (2.0,), "viewmat must"), (("K", 0, 1), (0.5,), "has a skew"), (("K", 1, 1), (0, 1e13), "focal len"),
        (("model",), ("own",), "own"), (("distortion",), ([0.5],), "distortion"),
    ],
)  # fmt: skip
def test_a_stored_camera_that_cannot_be_rendered_is_refused(made, run, place, values, words):
    name = next(iter(made[1]["cameras"]))
    for value in values:
        put_record(run, replaced(made[1], ("cameras", name, *place), value))
        with pytest.raises(DataError, match=rf"config\.json: .*cameras\.{name}.*{words}"):
            open_run(run, "cpu")


def test_any_value_in_the_place_of_any_other(made, run):
    refused, short = 0, shortened(made[1])
    for path in places(short):
        for value in NASTY:
            put_record(run, replaced(short, path, value))
            try:
                read_record(run)
            except DataError:
                refused += 1
    assert refused > 300


@pytest.mark.fault
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_no_command_fails_on_what_the_schema_allows(made, run, tmp_path, capsys):
    """Numbers that no fit writes lead to an odd image or to a sentence, not to a defect."""
    short, tried = shortened(made[1]), 0
    for path in places(short):
        for value in [*NASTY, 0, 1, 1e-300, 1e300, -1e300, 2**16]:
            put_record(run, replaced(short, path, value))
            try:
                read_record(run)
            except DataError:
                continue
            tried += 1
            codes = [
                main(["export", str(run), "--to", str(tmp_path / "a.ply")]),
                main(["eval", str(run), "--device", "cpu"]),
            ]
            if path[-1:] not in (("width",), ("height",)):  # an image of 2^16 px takes too long
                codes += [
                    main(["render", str(run), "--path", p, "--frames", "1", "--device", "cpu"]) for p in ("views", "turntable")
                ]
            assert not set(codes) - {0, 2, 3, 4}, (path, value, capsys.readouterr().err)
    assert tried > 100


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ("[]", "an object"), ("{", "not valid JSON"), ("[" * 100_000, "nested deeper"), ("{}", "step is missing"),
        ({"step": -1}, "step must be"), ({"step": True}, "step must be"), ({"step": 1e400}, "step must"),
    ],
)  # fmt: skip
def test_a_state_with_a_right_checksum(run, state, words):
    tensors, _ = load_checkpoint(run)
    put_checkpoint(run, tensors, state)
    with pytest.raises(DataError, match=words):
        open_run(run, "cpu")


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("params.quats", lambda t: t[:-1]), ("params.quats", lambda t: t[:, :3]), ("params.means", lambda t: t[None]),
        ("params.means", lambda t: t.new_tensor(1.0)), ("params.means", lambda t: None), ("params.means", lambda t: t / 0),
        ("params.logit_opacities", lambda t: t[:, None]), ("params.sh", lambda t: t[:, :0]),
        ("params.sh", lambda t: t.repeat(1, 5, 1)[:, :5]), ("params.log_scales", lambda t: t.double()),
    ],
)  # fmt: skip
def test_tensors_that_do_not_fit_together(run, tmp_path, name, change):
    tensors, state = load_checkpoint(run)
    changed = change(tensors.pop(name))
    tensors |= {} if changed is None else {name: changed}
    put_checkpoint(run, tensors, state)
    with pytest.raises(DataError, match=name.removeprefix("params.") + "|means"):
        open_run(run, "cpu")
    model = {n.removeprefix("params."): t.contiguous() for n, t in tensors.items() if n.startswith("params.")}
    header = {"format": "warpgs-model-1", "units": "file", "scale": "1.0", "offset": "[0, 0, 0]"}
    (tmp_path / "model").write_bytes(save(model, header))
    with pytest.raises(DataError):
        load_model(tmp_path / "model")


@pytest.mark.parametrize("offset", ["[" * 100_000, "{}", "[1, 2]", '["a", 1, 2]', "[1e400, 0, 0]", "x"])
def test_a_header_of_a_model_that_is_damaged(made, tmp_path, offset):
    save_model(tmp_path / "m", open_run(made[0] / "run", "cpu").gaussians(), units="file")
    tensors = load_model(tmp_path / "m").gaussians("file").tensors()
    header = {"format": "warpgs-model-1", "units": "file", "scale": "1.0", "offset": offset}
    (tmp_path / "m").write_bytes(save(tensors, header))
    with pytest.raises(DataError, match="header is damaged"):
        load_model(tmp_path / "m")


@pytest.mark.parametrize("degrees", [[0], [4] * 50, [-1] * 50, [[0] * 50], [3] * 50, [0.5] * 50])
def test_packed_coefficients_that_do_not_go_with_their_degrees(run, degrees):
    """As `warpgs prune` stores them."""
    tensors, state = load_checkpoint(run)
    tensors |= {"params.sh_packed": tensors.pop("params.sh")[:, :1].reshape(-1)}
    put_checkpoint(run, tensors | {"degrees": torch.tensor([0] * 50)}, state)
    assert open_run(run, "cpu").gaussians().sh.shape == (50, 1, 3)
    put_checkpoint(run, tensors | {"degrees": torch.tensor(degrees)}, state)
    with pytest.raises(DataError, match="do not fit degrees"):
        open_run(run, "cpu")


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("order", [99]), ("order", [True]), ("step", 99), ("step", None), ("extent", 0), ("extent", "a"), ("notes", [1]),
        ("strategy", None), ("strategy", {"was_reset": 1}),
        ("generator", lambda t: t[:-1]), ("generator", lambda t: t.int()), ("generator", lambda t: None),
        ("exp_avg.means", lambda t: t[:-1]), ("exp_avg.means", lambda t: t.double()), ("columns.grad_sum", lambda t: t[:-1]),
        ("params.sh", lambda t: t[:, :1]), ("params.means", lambda t: t.new_tensor(1.0)),
    ],
)  # fmt: skip
def test_a_checkpoint_that_no_fit_can_go_on_from(made, run, capsys, name, change):
    tensors, state = load_checkpoint(run)
    if not callable(change):
        state |= {name: change}
    elif (changed := change(tensors.pop(name))) is not None:
        tensors[name] = changed
    put_checkpoint(run, tensors, state)
    assert main(["fit", str(made[0] / "scene"), "--out", str(run), "--resume", *FLAGS]) == 3
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and TENSORS in error and (callable(change) or name in error)


def test_files_whose_header_says_nothing(run, tmp_path):
    """The entry for words in a safetensors header is there and null; safetensors itself reads such a file."""
    text = json.dumps({"__metadata__": None, "a": {"dtype": "U8", "shape": [1], "data_offsets": [0, 1]}}).encode()
    body = len(text).to_bytes(8, "little") + text + b"\0"
    (run / TENSORS).write_bytes(body + hashlib.sha256(body).digest())
    (tmp_path / "m.safetensors").write_bytes(body)
    with pytest.raises(DataError, match=TENSORS):
        load_checkpoint(run)
    with pytest.raises(DataError, match=r"m\.safetensors"):
        load_model(tmp_path / "m.safetensors")


def test_a_log_without_what_the_report_shows(made, run):
    """A step without a loss leaves a gap in the curve; lines that are no events are no part of it."""
    lines = [
        '{"step": 1}',
        '{"step": 2, "loss": "x"}',
        '{"step": true}',
        '{"step": 3, "loss": null}',
        "[" * 100_000,
        '{"step": 4}',
    ]
    (run / "metrics.jsonl").write_text("\n".join(lines))
    assert [e["step"] for e in read_events(run / "metrics.jsonl")] == [1, 3, 4]
    assert main(["fit", str(made[0] / "scene"), "--out", str(run), "--resume", *FLAGS]) == 0
    assert "Training loss" in (run / "report.html").read_text()
