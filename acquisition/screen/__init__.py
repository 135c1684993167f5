"""What people see of a run: progress, the live page, the quick look."""
