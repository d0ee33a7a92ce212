"""From verified matches to cameras and points: incremental mapping, completion and retriangulation."""
