"""3D Tiles of the splat, with a page that shows them in a browser."""
