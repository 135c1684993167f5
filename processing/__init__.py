"""Everything that needs no hardware: Mueller algebra, instrument models, reduction, diagnosis, reports."""
