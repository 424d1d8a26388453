"""The C export of ``H``, its gradient and the objective, and the loader of a built export."""
