"""Camera poses from photographs or a video alone, by structure from motion (extra `poses`, pycolmap)."""
