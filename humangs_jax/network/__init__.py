"""The network: `humangs`, one module made of exchangeable `parts`. Also has presets, weights files,
and the conversion of the released checkpoint.
"""
