"""Estimating a camera's response curve, blur and lights from the balls it sees."""
