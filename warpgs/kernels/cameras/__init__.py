"""Camera models, one file each; `base` says what a model must supply."""
