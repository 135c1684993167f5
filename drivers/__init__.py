"""What talks to hardware: motion axes, cameras, light sources. Imports nothing else of ours."""
