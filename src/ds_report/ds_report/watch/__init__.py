"""Page that shows a campaign while it runs, or after it."""
