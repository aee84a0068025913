"""The viewer: models in a browser, from this machine's own server or from one file. Needs the extra `view`."""
