"""Reading surveys and writing results; knows the model and nothing else of ours."""
