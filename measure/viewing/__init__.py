"""What was measured, to look at: the Rerun recording, its viewer, and the report."""

import os

# Rerun's own lines about a viewer that is slow or gone would stand between ours.
os.environ.setdefault(
    "RUST_LOG", "warn,re_grpc_client=off,re_quota_channel=off,re_sdk::recording_stream=off"
)
