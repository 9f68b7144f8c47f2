"""Integrate impacts with restitution on stops, rest in contact, and dry friction."""
