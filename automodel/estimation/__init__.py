"""Filters and estimators, without images."""
