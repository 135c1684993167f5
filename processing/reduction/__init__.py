"""From counts to Mueller and Stokes images."""
