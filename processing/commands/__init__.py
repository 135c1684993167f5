"""The commands of `process`: a module for each group marks its functions `@command` and imports its work late."""
