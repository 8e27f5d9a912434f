"""What was measured, to look at: the Rerun recording, its viewer, and the report."""
