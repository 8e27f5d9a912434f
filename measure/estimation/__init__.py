"""What triangulators and pose solvers share: N-view points, pose fits, layouts of bodies."""
