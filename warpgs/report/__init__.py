"""What a run shows of itself: progress, logs, pictures, films and the report page."""
