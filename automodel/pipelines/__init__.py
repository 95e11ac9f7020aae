"""The papers' pipelines, side by side, each in a module of its name; `automodel.config.parts` names them."""
