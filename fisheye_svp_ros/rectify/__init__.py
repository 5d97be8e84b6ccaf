"""Undistortion and rectification maps, and the SVP lens nearest to a lens at a range."""
