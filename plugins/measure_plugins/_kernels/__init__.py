"""Compiled helpers that the outline wings and the joint fit share."""
