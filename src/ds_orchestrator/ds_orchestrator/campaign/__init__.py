"""Campaigns: configuration, folder, and the stages that drive."""
