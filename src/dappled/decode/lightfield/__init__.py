"""The light field, its views, and pictures focused anew."""
