"""From poses and odometry over time to one belief."""
