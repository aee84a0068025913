"""Readers of scene folders: one file per format; `load_scene` turns each into a `warpgs.scene.Scene`."""
