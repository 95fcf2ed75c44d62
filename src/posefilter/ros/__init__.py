"""ROS 2 messages and bags, without ROS."""
