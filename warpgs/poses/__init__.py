"""Camera poses from photographs or a video, by structure from motion (extra `poses`, pycolmap)."""
