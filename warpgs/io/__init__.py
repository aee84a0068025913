"""Dataset doors: one file per format, each giving a `warpgs.scene.Scene` in the house conventions."""
