"""Tables and plots of the documents, written from the checked-in result files."""
