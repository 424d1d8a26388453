"""The C export of a metric and its gradient, and the loader of a built export."""
