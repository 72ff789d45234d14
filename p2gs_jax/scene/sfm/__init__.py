"""Structure from motion with COLMAP: cameras and points from photographs, or points alone."""
