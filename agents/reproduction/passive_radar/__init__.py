"""Xu and Wang (2009)."""
