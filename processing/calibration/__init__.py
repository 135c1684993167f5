"""What is found out about an instrument or chosen for it before it measures."""
