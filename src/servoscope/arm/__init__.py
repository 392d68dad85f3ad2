"""Robot arms: the kinematics of a URDF, joint torques as a linear regression, and the loop file of an arm."""
