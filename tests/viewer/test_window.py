"""The viewer on a run: what it sends, renders and saves, without a browser; and beside a fit."""

import base64
import contextlib
import dataclasses
import json
import os
import shutil
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

import warpgs
from tests.viewer import wait_shown
from warpgs.app.cli import main
from warpgs.errors import DataError
from warpgs.geometry import convert_gaussians
from warpgs.pipeline.films.paths import fov_y, rig_among
from warpgs.pipeline.model.edit import any_of
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run import level
from warpgs.pipeline.run.folder import load_checkpoint, save_checkpoint
from warpgs.synthetic.demo import split_spec, write_demo
from warpgs.viewer import html, watch, window as windows
from warpgs.viewer.html import middle_first, wxyz_of
from warpgs.viewer.server import open_server, stop_server
from warpgs.viewer.window import (
    CROP,
    PATH,
    Window,
    box_json,
    content_of_file,
    content_of_run,
    frustum_scale,
    keyframe,
    placed,
    views_of,
)

pytest.importorskip("viser")
zstandard = pytest.importorskip("zstandard")
CONFIG = warpgs.FitConfig(steps=12, init=InitConfig(source="random", random_count=80))
SIZE = (40, 32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    write_demo(folder / "scene", views=8, width=SIZE[0], height=SIZE[1])
    with watch.live_view(folder / "run", port=0) as live:
        fit(folder, "run", live.look)
        wait_shown(live)
    return folder


def fit(folder, name, on_model=None):
    options = {"split": split_spec(8), "out": folder / name, "device": "cpu", "verbose": False, "on_model": on_model}
    warpgs.fit(str(folder / "scene"), CONFIG, **options)


@pytest.fixture(scope="module")
def window(folder):
    """A window on the run with its photographs and made-up layers, at a server that nobody asks."""
    content = content_of_run(folder / "run")
    views, notes = views_of(content)
    assert not notes and len(views) == 8
    fine = torch.arange(len(content.model.gaussians())) % 3 == 0
    server = open_server(0)
    opened = Window(server, dataclasses.replace(content, views=views, fine=fine))
    yield opened
    opened.close()
    stop_server(server)


def button(window, label):
    return next(h for h in window.server.gui._gui_input_handle_from_uuid.values() if getattr(h, "label", "") == label)


def test_looking_on_changes_nothing(folder):
    """The PLY of a fit that was looked at has the bytes of one that was not."""
    fit(folder, "alone")
    assert (folder / "run" / "point_cloud.ply").read_bytes() == (folder / "alone" / "point_cloud.ply").read_bytes()


def test_images_at_a_camera_are_those_of_the_rasterizer(window):
    """At a training camera: its render, depth, coverage and the error against its photograph; elsewhere no error."""
    content = window.content
    name = content.model.train[0]
    camera = content.model.scene_cameras[name]
    assert window.maps.view_at(camera) == name
    rgb = warpgs.rasterize(content.model.gaussians(), camera, content.model.options()).rgb.detach().clamp(0, 1).numpy()
    image, _ = window.maps.image(windows.RENDER, camera, content.model.gaussians(), 3)
    assert image.dtype == np.uint8 and np.abs(image / 255 - rgb).max() < 0.003
    images = {
        k: window.maps.image(k, camera, content.model.gaussians(), 3) for k in (windows.DEPTH, windows.COVERAGE, windows.ERROR)
    }
    assert all(i.shape == (SIZE[1], SIZE[0], 3) for i, _ in images.values())
    assert name in images[windows.ERROR][1]
    moved = camera.viewmat.copy()
    moved[0, 3] += 0.5
    assert (
        "step into a camera"
        in window.maps.image(windows.ERROR, dataclasses.replace(camera, viewmat=moved), window.shown(), 3)[1]
    )
    # an image is placed where another camera sees it
    camera = next(iter(window.content.model.scene_cameras.values()))
    K = camera.K * np.array([[2.0], [2.0], [1.0]])
    K[0, 2] += 6
    ramp = np.mgrid[:32, :40][1].astype(np.float32)[..., None].repeat(3, 2)
    out = placed(ramp, camera, dataclasses.replace(camera, K=K, width=92, height=64))
    np.testing.assert_allclose(out[20, 16:70, 0], (np.arange(16, 70) + 0.5 - 6) / 2 - 0.5, atol=0.02)


def test_layers_and_the_crop_box_choose_what_is_shown_and_saved(window, tmp_path):
    """Fine and coarse make the whole; keyframes are cameras of `warpgs render`, the box is that of `warpgs export`."""
    panel, count = window.panel, len(window.content.model.gaussians())
    shown = {}
    for layer in (windows.FINE_LAYER, windows.COARSE_LAYER):
        panel.layer.value = layer
        shown[layer] = len(window.shown())
    panel.layer.value = "all"
    assert shown[windows.FINE_LAYER] == (count + 2) // 3 and sum(shown.values()) == len(window.shown()) == count
    panel._crop.value = True
    assert 0 < len(window.shown()) < count
    n = window.content.model.normalization
    panel._save("crop.json", box_json(panel.crop_box(), n))
    stored = json.loads((window.content.stem / "crop.json").read_text())
    means = (window.shown().means.double().numpy() / n.scale + n.offset) - stored["center"]
    assert (np.abs(means @ np.array(stored["rotation"])) <= np.array(stored["size"]) / 2 + 1e-4).all()
    panel._crop.value = False
    panel, content, run = window.panel, window.content, str(window.content.stem)
    n, names = content.model.normalization, content.model.train[:2]
    panel._save(PATH, [keyframe(content.model.scene_cameras[name], 0.5 * i, n) for i, name in enumerate(names)])
    words = ["--path", f"{run}/{PATH}", "--frames", "2", "--out", str(tmp_path / "film"), "--device", "cpu"]
    assert main(["render", run, *words]) == 0
    for i, name in enumerate(names):
        camera = content.model.scene_cameras[name]
        K = camera.K.copy()
        K[:2, 2] = camera.width / 2, camera.height / 2  # a browser's camera has its principal point in the middle
        camera = dataclasses.replace(camera, K=K)
        wanted = warpgs.rasterize(content.model.gaussians(), camera, content.model.options()).rgb.detach().clamp(0, 1).numpy()
        image = np.asarray(Image.open(tmp_path / "film" / f"{i:04d}.png").convert("RGB")) / 255
        assert image.shape == wanted.shape and np.abs(image - wanted).max() < 0.01
    panel._crop.value = True
    panel._save(CROP, box_json(panel.crop_box(), n))
    whole = ["export", run, "--to", str(tmp_path / "a.ply")]
    assert main([*whole, "--crop", f"{run}/{CROP}"]) == 0
    shown = convert_gaussians(window.shown(), n, "scene", "file").means
    panel._crop.value = False
    assert torch.equal(warpgs.read_ply(tmp_path / "a.ply").means, shown)


def test_a_page_of_photographs_on_their_side_turns_about_the_direction_that_they_have_in_common(folder, tmp_path, monkeypatch):
    """One photograph is shown upright, and the others still lie: together they would have another direction."""
    real, given = html.open_run, []
    roll = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])

    def lying(*words):
        run = real(*words)
        cameras = {n: dataclasses.replace(c, viewmat=roll @ c.viewmat) for n, c in run.scene_cameras.items()}
        return dataclasses.replace(run, scene_cameras=cameras)

    monkeypatch.setattr(html, "open_run", lying)
    monkeypatch.setattr(html, "write_html", lambda path, *words: given.append(words) or (path.write_text("") or []))
    html.export_html(folder / "run", tmp_path / "scene.html")
    gaussians, *_, normalization = given[0]
    run = lying(folder / "run", "cpu")
    up = rig_among([run.scene_cameras[n] for n in run.train], gaussians.means.double().numpy()).up
    np.testing.assert_allclose(normalization.up, up, atol=1e-6)


def test_the_first_view_is_that_of_the_page_and_a_narrow_window_shows_the_whole_width(window):
    """The middle training camera, as in scene.html; photographs there are hidden; a narrow window has a wider field of view."""
    model, server = window.content.model, window.server
    middle = middle_first([model.scene_cameras[n] for n in model.train], model.gaussians())[0]
    assert middle is not model.scene_cameras[model.train[0]]
    np.testing.assert_array_equal(server.initial_camera.position, middle.center)
    client = SimpleNamespace(atomic=contextlib.nullcontext, camera=SimpleNamespace(aspect=2.0))
    window.step_into(model.train[0], client)
    assert not np.allclose(client.camera.position, middle.center)
    (back,) = button(window, "Reset")._impl.update_cb
    client.camera.fov = 0.1
    back(SimpleNamespace(client=client))
    for name in ("position", "look_at", "fov"):
        np.testing.assert_allclose(getattr(client.camera, name), getattr(server.initial_camera, name), atol=1e-6)
    visible = {name: frustum.visible for name, frustum in window._frusta.items()}
    first = next(n for n, c in window.content.model.scene_cameras.items() if c is window.first)
    assert not visible[first] and any(visible.values())
    # viser keeps the volume of a frustum: with a long lens, a picture far ahead would cover the model
    K = np.diag([10.0, 10.0, 1]) @ middle.K
    sizes = frustum_scale(middle, 0.4), frustum_scale(dataclasses.replace(middle, K=K), 0.4)
    tangents = (middle.height / 2 / focal for focal in (middle.K[1, 1], K[1, 1]))
    aspect = middle.width / middle.height
    ahead = [size / np.cbrt(t**2 * aspect / 3) for size, t in zip(sizes, tangents)]
    assert sizes[0] == 0.4 and ahead == pytest.approx([0.97, 1], rel=0.03)
    camera = window.first
    for aspect, side in ((0.46, camera.width / camera.K[0, 0] / 0.46), (2.0, camera.height / camera.K[1, 1])):
        state = SimpleNamespace(aspect=aspect, on_update=lambda _: None, fov=0.1)
        client = SimpleNamespace(atomic=contextlib.nullcontext, camera=state)
        window._connected(client)
        assert state.fov == pytest.approx(2 * np.arctan(side / 2))
        state.fov = 0.1
        window.move(camera, client)
        assert state.fov == pytest.approx(2 * np.arctan(side / 2))


def test_a_browser_gets_the_image_that_it_asks_for(window, monkeypatch):
    camera = window.content.model.scene_cameras[window.content.model.train[0]]
    sent = []
    size = {"image_width": 64, "image_height": 48, "update_timestamp": 1.0}
    state = SimpleNamespace(position=camera.center, wxyz=np.array([1.0, 0, 0, 0]), fov=0.8, **size)
    scene = SimpleNamespace(set_background_image=lambda i, **_: sent.append(i))
    client = SimpleNamespace(client_id=7, camera=state, scene=scene)
    window.panel.kind.value = windows.DEPTH
    window._render_for(client)
    window._render_for(client)
    assert [i.shape for i in sent] == [(48, 64, 3)] and windows.MAPS[windows.DEPTH].split(",")[0] in window.panel._note.content
    window.panel.kind.value = windows.GAUSSIANS
    window._render_for(client)
    assert sent[-1].shape == (2, 2, 3) and not window.panel._note.visible
    panel, told = window.panel, []
    camera = window.content.model.scene_cameras[window.content.model.train[0]]
    monkeypatch.setattr(panel, "keyframes", [])
    monkeypatch.setattr(panel, "explain", told.append)
    monkeypatch.setattr(window, "camera_of", lambda client: camera)
    (append,) = button(window, "add this camera")._impl.update_cb
    for _ in range(windows.MAX_KEYFRAMES + 3):
        append(SimpleNamespace(client=None))
    assert len(panel.keyframes) == windows.MAX_KEYFRAMES and told == ["a path has at most 1,000 keyframes"] * 3


def test_an_unknown_wish_ends_no_thread(window, monkeypatch):
    """The panel says what is wrong, and the thread that renders goes on."""
    monkeypatch.setattr(window.server, "get_clients", lambda: {1: SimpleNamespace(client_id=1)})
    told, said_all = [], threading.Event()

    def explain(note):
        told.append(note)
        said_all.set()

    def fail(client):
        raise KeyError("unknown")

    monkeypatch.setattr(window, "_render_for", fail)
    monkeypatch.setattr(window.panel, "explain", explain)
    for _ in range(2):
        said_all.clear()
        window._wake.set()
        assert said_all.wait(60) and window._thread.is_alive()
    assert set(told) == {"no image: KeyError: 'unknown'"}


@pytest.mark.skipif(os.name == "nt", reason="links need a right that users often lack")
@pytest.mark.parametrize("linked", ["000006.png", "."])
def test_no_image_of_a_run_is_read_through_a_link(window, tmp_path, monkeypatch, linked):
    """The sheet of a run that somebody else made may lead to an image of the user's; a note says so, and nothing is shown."""
    run, own, pressed, shown, told = tmp_path / "run", tmp_path / "own", [], [], []
    for folder in (run, own):
        folder.mkdir()
    Image.new("RGB", (8, 8)).save(own / "000006.png")
    if linked == ".":
        (run / "sampling").symlink_to(own)
    else:
        (run / "sampling").mkdir()
        (run / "sampling" / linked).symlink_to(own / linked)
    content = dataclasses.replace(window.content, stem=run, sheet=run / "sampling" / "000006.png")
    monkeypatch.setattr(window.panel, "content", content)
    monkeypatch.setattr(window.panel, "explain", told.append)
    button = SimpleNamespace(on_click=pressed.append)
    monkeypatch.setattr(window.panel.server.gui, "add_button", lambda *_, **__: button)
    window.panel._add_sampling()
    pressed[0](SimpleNamespace(client=SimpleNamespace(gui=SimpleNamespace(add_modal=lambda _: shown.append(1)))))
    assert not shown and len(told) == 1 and "is a link" in told[0]


def test_a_ply_and_what_is_neither(folder, tmp_path):
    content = content_of_file(folder / "run" / "point_cloud.ply")
    assert not content.model.scene_cameras and content.saved("crop.json") == folder / "run" / "point_cloud-crop.json"
    middle = content.model.gaussians().means.double().quantile(0.5, dim=0)
    assert middle.abs().max() < 1
    assert main(["convert", str(folder / "run" / "point_cloud.ply"), str(tmp_path / "a.sog")]) == 0
    content = content_of_file(tmp_path / "a.sog")
    assert len(content.model.gaussians()) > 50 and content.saved("path.json") == tmp_path / "a-path.json"
    (tmp_path / "a.txt").write_text("x")
    for wrong in (tmp_path / "a.txt", tmp_path / "none", tmp_path):
        with pytest.raises(DataError):
            watch.view(wrong, 0)


def test_a_run_is_followed_until_it_is_interrupted(folder, monkeypatch, capsys):
    shown: list = []
    polls, times = iter(range(3)), iter((None, None, 1.0, 2.0))

    def pause():
        if next(polls) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(watch, "_pause", pause)
    monkeypatch.setattr(watch, "modified", lambda _: next(times))
    monkeypatch.setattr(watch, "Window", lambda _, content: SimpleNamespace(content=content, show=shown.append))
    monkeypatch.setattr(watch, "open_server", lambda port: SimpleNamespace(stop=lambda: None))
    monkeypatch.setattr(watch, "address", lambda _: "http://127.0.0.1:1/word/")
    assert main(["view", str(folder / "run"), "--device", "cpu"]) == 0
    told = capsys.readouterr().out
    assert len(shown) == 1
    assert all(words in told for words in ("waiting for the first checkpoint", "step 12", "http://127.0.0.1:1/word/"))


def test_the_ruler_picks_and_scales_as_the_command_does(folder, tmp_path, monkeypatch):
    """Clicks at a training camera are its pixels on the command line; a length becomes the scale, three points the ground.

    Clicks are matched in training photographs, except at edges, as by the command; without them, depth is the model's.
    """
    run = shutil.copytree(folder / "run", tmp_path / "run")
    record, (tensors, state) = json.loads((run / "config.json").read_text()), load_checkpoint(run)
    for values in record["cameras"].values():  # a browser's camera has its principal point in the middle
        values["K"][0][2], values["K"][1][2] = SIZE[0] / 2, SIZE[1] / 2
    (run / "config.json").write_text(json.dumps(record))
    tensors["params.logit_opacities"][:] = 4
    save_checkpoint(run, tensors, state)
    server = open_server(0)
    content = content_of_run(run)
    window = Window(server, dataclasses.replace(content, views=views_of(content)[0]))
    model, panel, asked = window.content.model, window.panel, []
    monkeypatch.setattr(
        level, "matched_depth", lambda photographs, *pick: asked.append((*photographs,)) or (2.0 if photographs else None)
    )
    monkeypatch.setattr(level, "plane_depth", lambda depth, row, column: (depth[row, column], 9.0 * (row == rows[0]), 0.0, 0.0))
    camera = model.scene_cameras[model.train[0]]
    rows, columns = np.nonzero(warpgs.rasterize(model.gaussians(), camera, model.options()).alpha.detach().numpy() > 0.6)
    eye = SimpleNamespace(wxyz=wxyz_of(camera), position=camera.center, fov=fov_y(camera))
    eye.image_width, eye.image_height = SIZE
    try:
        button(window, "click points").value = True
        (click,), (store,) = server.scene._scene_pointer_cb, button(window, "set scale")._impl.update_cb

        def measured(*ends):
            for i in ends:
                at = (columns[i] + 0.5) / SIZE[0], (rows[i] + 0.5) / SIZE[1]
                click.callback(SimpleNamespace(client=SimpleNamespace(camera=eye), screen_pos=at))
            return panel.measured.content

        measured(0)
        store(None)
        assert "pick 2 points first" in panel._note.content
        photographs, _ = level.photographs_of(model)
        places = [level.picked(model, f"{model.train[0]}:{columns[i]},{rows[i]}", photographs) for i in (0, -1)]
        units, error = level.distance(model.normalization, *places)
        told = f"2 points; {units:.4g} units between the last two, uncertain by {100 * error:.2g} %; 1 of 2 picks"
        told += " were matched in training photographs"
        assert measured(-1) == told + "; at an edge: point 1; pick places away from edges" and asked == [model.train] * 2
        button(window, "length [m]").value = 3.0
        store(None)
        assert "in metres" in panel.measured.content and measured(0, -1).startswith("4 points; 3 m between the last two,")
        button(window, "click points").value = False
        button(window, "click points").value = True  # picks begin anew
        (click,) = server.scene._scene_pointer_cb
        window.show(dataclasses.replace(window.content, views={}))
        assert "%; 0 of 2 picks were matched in training photographs; at an edge: point 1;" in measured(0, -1)
        assert pressed(window, "set ground") == "pick 3 points first"
        measured(len(rows) // 2)
        pressed(window, "set ground")
        assert "the ground's tilt is uncertain by" in panel.measured.content
        places = [level.picked(model, f"{model.train[0]}:{columns[i]},{rows[i]}", {}) for i in (0, -1, len(rows) // 2)]
        up, by_photographs = level.grounded(model, places)[0].up, level.photographed(model)[0].up
        np.testing.assert_allclose(warpgs.open_run(run).normalization.up, up, atol=1e-6)
        pressed(window, "level by photographs")
        np.testing.assert_allclose(warpgs.open_run(run).normalization.up, by_photographs, atol=1e-6)
        assert np.abs(up - by_photographs).max() > 0.01
    finally:
        window.close()
        stop_server(server)
    assert warpgs.open_run(run).normalization.scale == pytest.approx(model.normalization.scale * units / 3)


def pressed(window, label):
    """Press a button of the panel; returns the note that is then shown."""
    window.panel.explain("")
    (press,) = button(window, label)._impl.update_cb
    press(None)
    return window.panel._note.content.replace("\\", "")


@pytest.mark.parametrize("kind", ["run", "file"])
def test_a_clean_up_is_shown_undone_and_saved(folder, tmp_path, kind):
    """What would go is shown in colour, then removed, put back, and saved beside the model, which keeps its bytes."""
    run = shutil.copytree(folder / "run", tmp_path / "run")
    tensors, state = load_checkpoint(run)
    tensors["params.logit_opacities"][:3], tensors["params.logit_opacities"][3:] = -6, 4
    tensors["params.means"][3] = 1e4
    save_checkpoint(run, tensors, state)
    gaussians = warpgs.open_run(run, "cpu").gaussians()
    if kind == "file":
        warpgs.write_ply(tmp_path / "a.ply", gaussians, warpgs.open_run(run, "cpu").normalization)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    server = open_server(0)
    window = Window(server, content_of_run(run) if kind == "run" else content_of_file(tmp_path / "a.ply"))
    panel, whole = window.panel, window.shown()
    try:
        assert pressed(window, "undo") == "nothing was removed" and "remove first" in pressed(window, "save a copy")
        panel.in_colors.value = True
        shown = window.shown()
        assert len(shown) == len(whole) and (shown.logit_opacities[:3].sigmoid() > 0.59).all()
        changed = (shown.sh != whole.sh).flatten(1).any(1)
        assert changed[:4].all() and torch.equal(changed, any_of(window.going().values(), changed)) and changed.sum() < 30
        panel.reasons["opacity"].value = panel.reasons["unseen"].value = False
        assert not window.going().keys() & {"opacity", "unseen"}
        assert torch.equal(window.shown().sh[:3], whole.sh[:3])
        panel.reasons["opacity"].value = panel.reasons["unseen"].value = True
        assert not pressed(window, "remove") and len(window.shown()) == len(whole) - changed.sum()
        assert pressed(window, "remove") == "nothing would go"
        assert not pressed(window, "undo") and len(window.shown()) == len(whole)
        pressed(window, "remove")
        saved = [pressed(window, "save a copy") for _ in range(2)]
        window.show(window.content)
        assert len(window.shown()) == len(whole)  # a new checkpoint
    finally:
        window.close()
        stop_server(server)
    assert {p: p.read_bytes() for p in before} == before
    for line, name in zip(saved, ("run-pruned", "run-pruned-2") if kind == "run" else ("a-pruned.ply", "a-pruned-2.ply")):
        assert str(tmp_path / name) in line
        left = warpgs.open_run(tmp_path / name).gaussians() if kind == "run" else warpgs.read_ply(tmp_path / name)
        assert len(left) == len(whole) - changed.sum() and left.logit_opacities.min() > 0


def test_a_page_names_nobody(folder, tmp_path, capsys):
    """One file without a path, an image's name or an address in the network; cleaned, and it starts at a training camera."""
    assert main(["export", str(folder / "run"), "--to", str(tmp_path / "scene.html"), "--rotate", "level"]) == 0
    text = (tmp_path / "scene.html").read_text("utf-8")
    assert "default-src 'none'" in text and "<title>scene</title>" in text
    assert text.index("URLSearchParams=") < text.index("<script data-p")
    head, _, data = text.partition('__VISER_EMBED_DATA__="')
    assert str(folder) not in text and "warpgs/" not in head
    scene = zstandard.ZstdDecompressor().decompressobj().decompress(base64.b64decode(data.partition('"')[0])[8:])
    assert b"/gaussians" in scene and not [w for w in (b".png", b"run", str(folder).encode()) if w in scene]
    said = capsys.readouterr().out
    assert "without a network" in said and "removed" not in said and "rotated by" in said


def test_names_that_are_not_utf8(window, monkeypatch):
    chosen, texts = [], []
    (camera, *_) = window.content.model.scene_cameras.values()
    model = dataclasses.replace(window.content.model, scene_cameras={"b\udce4r.png": camera})
    content = dataclasses.replace(window.content, title="b\udce4r", model=model)
    monkeypatch.setattr(window.panel, "content", content)
    monkeypatch.setattr(window, "step_into", lambda name, client: chosen.append(name))

    def dropdown(label, options, initial_value):
        texts.extend(options)
        chooser = SimpleNamespace(value=options[-1], on_update=lambda step: step(SimpleNamespace(client=None)))
        return chooser

    monkeypatch.setattr(window.panel.server.gui, "add_dropdown", dropdown)
    window.panel._add_stepping()
    window.panel.explain("of b\udce4r")
    assert chosen == ["b\udce4r.png"] and texts[-1] == "b\\xe4r.png"
    window.panel._note.content.encode("utf-8")
    window.panel.explain("")
