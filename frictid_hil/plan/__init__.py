"""What is asked of a robot: the plan, its limits, and what the plan knows of the arm."""
