"""The nodes: the only package that imports rclpy."""
