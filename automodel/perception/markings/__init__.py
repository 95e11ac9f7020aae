"""Markings in one image: the network, ridges, thresholds, white areas, crossings."""
