"""Report of a run: progress, logs, images, films and the HTML page."""
