"""Camera models, one file each; `base` defines their interface."""
