"""The robots as data: model files, visual description and layouts."""
