"""Poses turned into what a laboratory asks for: rests, tips, lengths, curves; no files."""
