"""Models, training, scores, runs, films, farms and studies."""
