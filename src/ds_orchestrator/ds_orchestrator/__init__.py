"""Search, campaign, store, bags, feature maps, evaluation, report and command line."""
