"""Raw data sets -> the scene-list layout or capture folders, by the published protocol. See docs/datasets.md."""
