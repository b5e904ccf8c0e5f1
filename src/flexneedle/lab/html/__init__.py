"""Parts of HTML pages of results: style, figures as data URLs, tables for narrow screens."""
