"""The web study: people play with agents made from their own sentences (App. H)."""
