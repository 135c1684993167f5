"""One capture: plan, checks, runner, writer."""
