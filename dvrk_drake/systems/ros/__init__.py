"""ROS 2 topics of an arm over DDS, with the names of the Collaborative Robotics Toolkit (CRTK)."""
