"""The papers' pipelines, side by side."""
