"""The lab's data in the browser: one local web application for before, during and after a measurement."""
